"""Tables of parameters: a shaft in CSV or XLSX gives the answer of the same values in SI units."""

import json

import openpyxl
import pytest

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.cli import main
from drivetrain_jax.runs.physical import read_table

ROWS = (
    ("length [mm]", "outer_diameter (mm)", "inner_diameter [mm]", "material", "k_A [kN/m]", "k_D [N/m]"),
    (300, 60, 0, "steel", 5000, 5e6),
    (1200, 90, 82, "", "", ""),
    (300, 60, 0, "", "", ""),
)


def written(path, separator=",", rows=ROWS):
    path.write_text("\ufeff" + "\n".join(separator.join(map(str, row)) for row in rows) + "\n\n", encoding="utf-8")
    return path


def workbook(path):
    book = openpyxl.Workbook()
    for row in ROWS:
        book.active.append([None if cell == "" else cell for cell in row])
    book.save(path)
    return path


@pytest.mark.parametrize("kind", [",", ";", "\t", "xlsx"])
def test_a_shaft_from_a_table_has_its_critical_speeds(tmp_path, capsys, kind):
    """The stepped steel shaft of docs/systems/bicardan.md: 3646, 8088 and 13019 rpm."""
    path = workbook(tmp_path / "shaft.xlsx") if kind == "xlsx" else written(tmp_path / "shaft.csv", kind)
    table = read_table(path)
    assert table["length"] == ["300.0 mm", "1200.0 mm", "300.0 mm"]
    assert table["k_A"] == "5000.0 kN/m" and table["material"] == "steel"
    if kind in (",", "xlsx"):
        assert main(["point", "bicardan", "critical_speeds", "modes=3", "--data", str(path), "--json"]) == 0
        speeds = json.loads(capsys.readouterr().out)["values"]["critical_speed"]["value"]
        assert [round(speed) for speed in speeds] == [3647, 8088, 13019]
        stiff = dt.point("bicardan", "critical_speeds", data=path, k_A="50 MN/m", modes=3)
        assert stiff.parameters["k_A"] == 5e7 and stiff.parameters["k_D"] == 5e6


def test_a_comment_in_front_of_a_table_is_left_out(tmp_path):
    rows = [("# shaft.csv",), *ROWS]
    assert read_table(written(tmp_path / "t.csv", rows=rows)) == read_table(written(tmp_path / "s.csv"))
    for separator in (",", ";", "\t"):
        rows = [("",), ("# shaft.csv",), ("  ",), *ROWS]
        assert read_table(written(tmp_path / "e.csv", separator, rows)) == read_table(tmp_path / "s.csv")
    # A first column of numbers may be called #.
    assert read_table(written(tmp_path / "n.csv", rows=[("#", "k_A"), (1, 2.0)]))["k_A"] == 2.0


def test_headers_of_two_lines_and_of_blanks(tmp_path):
    rows = [('"length\n[mm]"', " ", '"outer\ndiameter"'), (300, "", 60)]
    assert read_table(written(tmp_path / "t.csv", rows=rows)) == {"length": "300.0 mm", "outer\ndiameter": 60.0}


def test_a_scene_overrides_its_table_and_the_command_line_both(tmp_path, capsys):
    scene = tmp_path / "shaft.toml"
    axis = '[axes]\nk_D = { values = [1e6, "5 MN/m"] }\n[fixed]\nk_A = 1e6\n'
    scene.write_text(f'system = "bicardan"\nanalysis = "critical_speeds"\noutputs = ["critical_speed"]\n{axis}')
    table = written(tmp_path / "shaft.csv", rows=[row[:-1] for row in ROWS])
    common = [str(scene), "--out", str(tmp_path / "s.nc"), "--data", str(table), "--set", "options.modes=1"]
    assert main(["run", *common]) == 0
    assert main(["status", *common, "--set", "fixed.k_A=1e6", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["state"] == "complete"
    assert main(["status", *common, "--set", "fixed.k_A=5e6", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["state"] == "stale"


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([("length [mm]",)], "no values"),
        ([("length [mm]", "length [m]"), (1, 2)], "two columns length"),
        ([("length [mm]", "k_A"), (1, 2), ("", 3)], "allowed"),
        ([("length [mm]",), (1,), ("",), (2,)], None),
        ([("length [mm]", "k_A"), (1, 1), ("", 2), (3, 3)], "empty cell between values"),
        ([("length [mm]",), ("1,5",)], "decimal point"),
        ([("length [mm]", "k_A"), ("", 1)], "is empty"),
    ],
)
def test_a_wrong_table_is_refused_with_its_column(tmp_path, rows, words):
    path = written(tmp_path / "t.csv", ";", rows)
    if words is None or words == "allowed":
        # Empty rows, and a shorter column, are no mistake.
        assert read_table(path)
        return
    with pytest.raises(InputError, match=words):
        read_table(path)


def test_files_of_another_kind_are_refused(tmp_path, capsys):
    (tmp_path / "t.ods").write_bytes(b"PK")
    (tmp_path / "t.xlsx").write_bytes(b"no workbook")
    (tmp_path / "t.csv").write_bytes(b"length\n\xff\xfe\n")
    for name, word in (
        ("t.ods", ".csv, .xlsx or .toml"),
        ("t.xlsx", "workbook"),
        ("t.csv", "UTF-8"),
        ("no.csv", "No such"),
    ):
        assert main(["point", "bicardan", "critical_speeds", "--data", str(tmp_path / name)]) == 2
        error = capsys.readouterr().err
        assert word in error and error.count("\n") == 1
