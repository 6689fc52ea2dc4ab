"""docs/benchmarks.md follows from the result files; a method with an unreported error is called silent."""

from __future__ import annotations

import math
import re
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import __main__ as runner
from benchmarks import page
from benchmarks.measure import (
    RESULTS,
    Contender,
    Judged,
    Method,
    Rung,
    Study,
    is_silent,
    load,
    measure,
    near,
    provenance,
    write_csv,
)
from drivetrain_jax import cli

pytestmark = pytest.mark.docs


def rung(setting="rtol=1e-9", error=1e-10, failed=0, noticed="", **changed):
    return Rung("cardan", "easy", "method", setting, error, 1e-5, 0.0, 8, failed, noticed)._replace(**changed)


def write(folder, name, rows, notes=()):
    write_csv(folder / f"{name}.csv", [row._asdict() if isinstance(row, Rung) else row for row in rows], notes)


def test_the_page_is_what_the_stored_files_give():
    assert page.text_of(RESULTS, page.PAGE) == page.PAGE.read_text(), "run `python -m benchmarks.page`"


def test_an_accelerator_is_measured_or_there_was_none(tmp_path, monkeypatch):
    """The page quotes accelerator.csv; without an accelerator nothing is measured."""
    import benchmarks.accelerator as accelerator

    told = [{"device": "ACME 1"} | {"cardan, chart": {"points": 900, "first_s": 4.0, "seconds": s}} for s in (0.1, 0.3)]
    for folder, radius in (("a", [1.0, 2.0]), ("b", [1.0, 2.0 + 2e-9])):
        (tmp_path / folder).mkdir()
        np.savez(tmp_path / folder / "0.npz", spectral_radius=radius, verdict=np.array([False, True]))
    line = accelerator.row(0, "cardan, chart", told, [tmp_path / "a", tmp_path / "b"])
    assert line["difference"] == pytest.approx(1e-9, rel=1e-6) and line["first_s"] == 4.0
    write(tmp_path, "accelerator", [line], ["ACME 1; warm"])
    text = page.text_of(tmp_path, tmp_path / "benchmarks.md")
    assert "ACME 1" in text and "| cardan, chart | 900 | 3,000 | 9,000 | 3 |" in text
    monkeypatch.setenv("JAX_PLATFORMS", "")
    with pytest.raises(SystemExit, match="jax finds none"):
        accelerator.measure(tmp_path, quick=True)


@pytest.mark.parametrize(("error", "fails"), [(1e-10, False), (1.0, True)])
def test_a_silent_failure_stands_on_the_page(tmp_path, error, fails):
    write(tmp_path, "precision_cardan", [rung(error=error, method="package, direct"), rung(error=1e-3)])
    text = page.text_of(tmp_path, tmp_path / "benchmarks.md").partition("## Silent failures")[2]
    assert "method (1)" in text and ("package, direct (cardan easy)" in text) is fails


def test_comparisons_with_the_best_rival(tmp_path):
    """Slower, faster, alone and level, in ratios and in words."""
    rows = []
    cases = (("easy", 2e-5, 1e-5), ("typical", 1e-5, 3e-5), ("near boundary", 1e-5, None), ("d", 1e-5, 1.05e-5))
    for region, own, rival in cases:
        rows.append(rung(region=region, method="package, direct", seconds_per_point=own))
        rows.append(rung(region=region, error=1e-10 if rival else 1e-3, seconds_per_point=rival or 1e-6))
    write(tmp_path, "precision_cardan", rows)
    pairs = page.compared(page.rungs(tmp_path))
    assert [p.ratio for p in pairs] == [pytest.approx(0.5), pytest.approx(3), math.inf, pytest.approx(1.05)]
    assert "Another library is faster in 1 of 4 regions" in page.losses(pairs)
    assert page.answer(pairs).endswith(
        "| 2 | 1 | 1 | 0.5 (easy, method) | no rival reaches the error (near boundary) |"
    )
    page.write_page(tmp_path, tmp_path / "benchmarks.md")
    assert (tmp_path / "precision_cardan.png").stat().st_size > 10_000


def test_every_file_has_its_commit_and_the_load_of_its_machine(tmp_path):
    def store(name, commit, cores):
        head = f"# commit: {commit}\n# load: {cores} cores by other programs\n"
        (tmp_path / f"{name}.csv").write_text(head + "a\n1\n")

    store("a", "1", 0.1)
    store("b", "2", 0.8)
    assert page.measurements(tmp_path).splitlines()[2:] == ["| a |  | 1 |  | 0.1 |", "| b |  | 2 |  | 0.8 |"]


def test_results_name_their_commit_and_the_load_by_others():
    facts = provenance()
    assert re.fullmatch(r"([0-9a-f]{7,}( with changes)?)|unknown", facts["commit"])
    assert re.fullmatch(r"\d+\.\d\d cores by other programs", facts["load"])


def test_a_page_without_any_file_says_so(tmp_path):
    text = page.text_of(tmp_path, tmp_path / "benchmarks.md")
    assert all(page.not_measured(f"precision_{system}") in text for system in page.TITLES)
    assert page.not_measured("accelerator") in text and "times as fast" not in text


def test_the_page_is_short_and_shows_how_many_cells_every_method_computed():
    text = page.PAGE.read_text()
    assert len(text) < 16_000 and text.index("| comparison |") < 500
    assert "| scipy RK45, rtol=1e-09 | 200 | " in text and "Omega from 0.1 to 2" in text


@pytest.mark.parametrize(
    ("setting", "silent"),
    [
        (rung(error=5e-10), False),
        (rung("rtol=1e-12", 1e-8, 0, "nan"), False),
        (rung(error=2e-6), True),
        (rung(error=math.nan), True),
        (rung(error=1e-12, failed=3), True),
        (rung(error=math.nan, failed=8, noticed="step_limit"), False),
        (rung("steps=8", 0.09), False),
        (rung("steps=8", 0.11), True),
        (rung("rtol=1e-3", 0.09), False),
        (rung("rtol=1e-3", 0.11), True),
    ],
)
def test_one_rule_says_what_is_silent(setting, silent):
    assert is_silent(setting.setting, setting.error, setting.failed, setting.noticed) is silent


def test_exceptions_and_warnings_are_how_a_user_notices(tmp_path):
    def broken():
        raise FloatingPointError("overflow")

    def warned():
        warnings.warn("tolerance not reached", RuntimeWarning, stacklevel=1)

    contenders = [
        Contender("cardan", "stiff", name, "rtol=1e-9", 2, lambda job=job: job, lambda _: Judged(0.5))
        for name, job in (("broken", broken), ("warned", warned), ("plain", lambda: None))
    ]
    rungs = measure(contenders, repeats=2)
    assert [r.noticed for r in rungs] == ["FloatingPointError", "RuntimeWarning", ""]
    assert [is_silent(r.setting, r.error, r.failed, r.noticed) for r in rungs] == [False, False, True]
    assert rungs[0].failed == 2 and math.isnan(rungs[0].error)
    write(tmp_path, "some", rungs, ["a note"])
    again = load(tmp_path, "some")
    assert [*again.rows.noticed] == [r.noticed for r in rungs] and again.notes == ["a note"]


def test_slow_contenders_are_timed_less_often(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])

    def job_of(seconds):
        return lambda: lambda: clock.__setitem__(0, clock[0] + seconds)

    contenders = [
        Contender("cardan", "easy", name, "rtol=1e-9", 2, job_of(seconds), lambda _: Judged(0.0))
        for name, seconds in (("slow", 2.0), ("medium", 0.375), ("fast", 0.125))
    ]
    rungs = measure(contenders, repeats=4, spent=1.0)
    assert [r.timed for r in rungs] == [1, 2, 4]
    assert [r.seconds_per_point for r in rungs] == [1.0, 0.1875, 0.0625]


def test_a_table_gives_a_contender_for_every_region_method_and_setting(tmp_path):
    methods = (
        Method("package, a", lambda region, setting: lambda: setting, 4, (1e-3, 1e-6), (1e-3,)),
        Method("b", lambda region, setting: lambda: setting, len, (2,), (2,), "{} steps", regions=("long",)),
    )
    study = Study("cardan", ("x", "long"), ("long",), methods, lambda region, setting, result: Judged(result))
    names = [(c.region, c.method, c.setting, c.points) for c in study.contenders(quick=False)]
    assert names[:2] == [("x", "package, a", "rtol=0.001", 4), ("x", "package, a", "rtol=1e-06", 4)]
    assert len(names) == 5 and names[-1] == ("long", "b", "2 steps", 4)
    study.run(True, tmp_path)
    assert [*page.rungs(tmp_path).error] == [1e-3, 2.0]
    replace(study, system="chart", quick=()).run(True, tmp_path)
    assert not (tmp_path / "precision_chart.csv").exists()


def test_fewer_neighbours_are_the_first_of_more():
    """A method that computes few points is compared with the same reference."""
    many, few = (near({"a": 2.0, "b": 3.0, "c": 1.0}, ("a", "b"), count, 0.01) for count in (8, 2))
    assert all(few[name].tolist() == many[name][:2].tolist() for name in "abc")
    assert many["a"][0] == 2.0 and many["c"].tolist() == [1.0] * 8
    assert np.ptp(many["a"]) > 0 and np.abs(many["b"] / 3 - 1).max() <= 0.01


@pytest.mark.parametrize(
    ("ratio", "number"), [(1.09, []), (0.92, []), (1.2, ["1.2"]), (2.0, ["2"]), (0.5, ["2"]), (0.1, ["10"])]
)
def test_speeds_within_a_tenth_are_level(ratio, number):
    told = page.against(ratio, "X")
    assert re.findall(r"[\d.]+", told) == number and told.endswith("X")
    assert ("slower" in told) is (number != [] and ratio < 1)


def test_bench_outside_a_checkout_is_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(cli, "__file__", str(tmp_path / "drivetrain_jax" / "cli.py"))
    assert cli.main(["bench", "--quick"]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "benchmarks/" in message


def test_an_unknown_system_is_refused_before_anything_runs(capfd):
    assert cli.main(["bench", "bycicle", "--out", str(Path("nowhere"))]) == 2
    message = capfd.readouterr().err
    assert message.count("\n") == 1 and "bycicle" in message
    assert not Path("nowhere").exists()


def test_the_page_is_written_without_a_study_that_fails(monkeypatch, tmp_path, capfd):
    monkeypatch.setattr(runner, "STUDIES", {"cardan": ("no_such_study",), "tripod": ()})
    assert runner.main(["--quick", "--out", str(tmp_path / "results"), "cardan"]) == 1
    assert "no_such_study: FAILED" in capfd.readouterr().out
    assert page.not_measured("precision_cardan") in (tmp_path / "results" / "benchmarks.md").read_text()
    assert runner.main(["--quick", "--out", str(tmp_path / "other"), "tripod"]) == 0


def test_every_study_exists_and_has_a_title():
    names = [name for names in runner.STUDIES.values() for name in names]
    text = {name: (Path(runner.ROOT) / "benchmarks" / f"{name.partition(':')[0]}.py").read_text() for name in names}
    assert all(f"\n{name.partition(':')[2]} = Study(" in text[name] for name in names if ":" in name)
    written = {match for code in text.values() for match in re.findall(r'= Study\(\s*"(\w+)"', code)}
    assert written == set(page.TITLES)
