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

import drivetrain_jax
from benchmarks import page_aims, page_precision
from benchmarks.page_text import NAMES, PAGE, answer, text_of
from benchmarks.page_text import warnings as remarks
from benchmarks.precision import Contender, Judged, Rung, is_silent, measure, read, write
from benchmarks.ratio_figure import ratios
from benchmarks.results_files import ResultFile, against, not_measured, plain
from benchmarks.timing import RESULTS, at_once, once, provenance, write_csv
from drivetrain_jax import cli

pytestmark = pytest.mark.docs


def rung(setting="rtol=1e-9", error=1e-10, failed=0, noticed=""):
    return Rung("cardan", "easy", "method", setting, error, 1e-5, 0.0, 8, failed, noticed)


def test_the_page_is_what_the_stored_files_give():
    assert text_of(RESULTS, PAGE) == PAGE.read_text(), "run `python -m benchmarks.page`"


def test_an_accelerator_is_measured_or_there_was_none(tmp_path, monkeypatch):
    """The page quotes accelerator.csv; without an accelerator nothing is measured."""
    import benchmarks.accelerator as accelerator

    page = tmp_path / "benchmarks.md"
    told = [{"device": "ACME 1"} | {"cardan, chart": {"points": 900, "first_s": 4.0, "seconds": s}} for s in (0.1, 0.3)]
    for folder, radius in (("a", [1.0, 2.0]), ("b", [1.0, 2.0 + 2e-9])):
        (tmp_path / folder).mkdir()
        np.savez(tmp_path / folder / "0.npz", spectral_radius=radius, verdict=np.array([False, True]))
    line = accelerator.row(0, "cardan, chart", told, [tmp_path / "a", tmp_path / "b"])
    assert line["difference"] == pytest.approx(1e-9, rel=1e-6) and line["first_s"] == 4.0
    write_csv(tmp_path / "accelerator.csv", [line], ["ACME 1; warm"])
    text = text_of(tmp_path, page)
    assert all(told in text for told in ("ACME 1", "cardan, chart 9,000 ", against(3, "")))
    monkeypatch.setenv("JAX_PLATFORMS", "")
    with pytest.raises(SystemExit, match="jax finds none"):
        accelerator.measure(tmp_path, quick=True)


@pytest.mark.parametrize(("error", "fails"), [(1e-10, False), (1.0, True)])
def test_a_silent_failure_stands_on_the_page(tmp_path, error, fails):
    rival, own = rung(error=1e-3), replace(rung(error=error), method="package, direct")
    write("precision_cardan", [own, rival], (), tmp_path)
    expected = {"package, direct": ["cardan easy"]} if fails else {}
    found = page_precision.load_precision(tmp_path).values()
    assert page_precision.silent(found) == expected | {"method": ["cardan easy"]}
    text = text_of(tmp_path, tmp_path / "benchmarks.md").partition("## Silent failures")[2]
    assert "method (1)" in text and ("package, direct (cardan easy)" in text) is fails


def test_comparisons_with_the_best_rival():
    """Slower, faster, alone and level, in the figure's ratios and in words."""
    rungs = []
    for region, own, rival in (("a", 2e-5, 1e-5), ("b", 1e-5, 3e-5), ("c", 1e-5, None), ("d", 1e-5, 1.05e-5)):
        rungs.append(replace(rung(), region=region, method="package, direct", seconds_per_point=own))
        error = 1e-10 if rival else 1e-3
        rungs.append(replace(rung(error=error), region=region, method="rival", seconds_per_point=rival or 1e-6))
    precise = {"cardan": page_precision.Precision("cardan", rungs)}
    found = {one.region: one.ratio for one in page_precision.compared(precise["cardan"])}
    assert found == {"a": pytest.approx(0.5), "b": pytest.approx(3), "c": math.inf, "d": pytest.approx(1.05)}
    assert "A rival is faster in 1 of 4 regions" in page_precision.losses(precise)
    panels = ratios(dict.fromkeys(NAMES), precise)
    assert [one.ratio for one in panels[page_precision.TITLES["cardan"]]] == [*found.values()]
    assert answer(panels).endswith("| 2 | 1 | 1 | 0.5 (a, rival) | no rival reaches the error (c) |")


def test_aims_are_met_or_missed_as_measured():
    def file(*rows):
        return ResultFile("x", {}, (), rows)

    chart = [
        ("drivetrain_jax direct", 4e5, 1e-10),
        ("heyoka batch", 2e5, 1e-10),
        ("heyoka batch, without eigenvalues", 5e5, "nan"),
    ]
    damping = [
        ("10", "package", 3.0),
        ("10", "heyoka batch", 1.0),
        ("100", "package", 1.0),
        ("100", "heyoka batch", 1.05),
    ]
    gears = [("3", "package", 4.0), ("3", "numpy svd", 1.0), ("4", "package", 2.0), ("4", "numpy svd", 1.0)]
    waiting = {"command": "query", "cpu_s": "0.9", "aim_s": "1", "first_cpu_s": "6", "first_aim_s": "5"}
    files = dict.fromkeys(NAMES) | {
        "throughput": file(*({"method": m, "cells_per_s": r, "max_error": e} for m, r, e in chart)),
        "damping": file(*({"zeta": z, "method": m, "us_per_point": t} for z, m, t in damping)),
        "planetary_throughput": file(*({"planets": p, "method": m, "gears_per_s": r} for p, m, r in gears)),
        "waiting": file(waiting),
    }
    rungs = [
        replace(rung(), region=region, method=method, seconds_per_point=spent)
        for region, method, spent in (
            ("easy", "package, direct", 1e-5), ("easy", "rival", 2e-5), ("typical", "package, direct", 2e-5),
            ("typical", "rival", 1e-5),
        )
    ]  # fmt: skip
    lines = page_aims.section(files, {"cardan": page_precision.Precision("cardan", rungs)}).splitlines()[4:]
    found = [tuple(cell.strip() for cell in line.split("|")[2:4]) for line in lines]
    assert found == [
        ("2", "met"), ("0.8", "**missed**"), ("1 of 2 ahead, ratios 0.5 to 2", "**missed**"), ("0.33", "**missed**"),
        ("1.1", "met"), ("4, 2", "**missed**"), ("0.9 s", "met"), ("6 s", "**missed**"),
    ]  # fmt: skip


def test_files_of_several_commits_or_of_a_loaded_machine_are_named():
    def file(commit, load):
        return ResultFile("x", {"commit": commit, "load": f"{load} cores by other programs"}, (), ())

    assert remarks({"a": file("1", 0.1), "b": file("1", 0.4), "c": None}) == []
    several, loaded = remarks({"a": file("1", 0.1), "b": file("2", 0.8)})
    assert "1 (a), 2 (b)" in several and "b (0.8)" in loaded and "a (" not in loaded


def test_results_name_their_commit_and_the_load_by_others():
    facts = provenance()
    assert re.fullmatch(r"([0-9a-f]{7,}( with changes)?)|unknown", facts["commit"])
    assert re.fullmatch(r"\d+\.\d\d cores by other programs|unknown", facts["load"])


def test_a_page_without_any_file_says_so(tmp_path):
    text = text_of(tmp_path, tmp_path / "benchmarks.md")
    unnamed = {"accelerator", "critical_speeds", "planetary_throughput", "chaos", "damping"}
    assert set(NAMES) - {name for name in NAMES if not_measured(name) in text} == unnamed
    assert "No GPU was available" in text and "times as fast" not in text


def test_the_page_is_short_and_shows_how_many_cells_every_method_computed():
    text = PAGE.read_text()
    assert len(text) < 15_000 and text.index("| comparison |") < 500
    assert "| scipy RK45, rtol 1e-09 | 200 | 202 | 1.08 | 1.1e-08 |" in text and "Omega from 0.1 to 2" in text


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
    assert is_silent(setting) is silent


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
    assert [is_silent(r) for r in rungs] == [False, False, True]
    assert rungs[0].failed == 2 and math.isnan(rungs[0].error)
    write("some", rungs, ["a note"], tmp_path)
    again = read(tmp_path / "some.csv")
    assert [(r.method, r.noticed, r.failed) for r in again] == [(r.method, r.noticed, r.failed) for r in rungs]


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


def test_two_threads_that_ask_for_the_same_make_it_once():
    made = []

    @once
    def make(key):
        time.sleep(0.02)
        made.append(key)
        return object()

    first, second = at_once([lambda: make("a")] * 2)
    assert first is second and made == ["a"]


@pytest.mark.parametrize(
    ("ratio", "number"), [(1.09, []), (0.92, []), (1.2, ["1.2"]), (2.0, ["2"]), (0.5, ["2"]), (0.1, ["10"])]
)
def test_speeds_within_a_tenth_are_level(ratio, number):
    told = against(ratio, "X")
    assert re.findall(r"[\d.]+", told) == number and told.endswith("X")
    assert ("slower" in told) is (number != [] and ratio < 1)


def test_numbers_of_a_table_have_no_exponents_but_small_ones():
    cells = {"1.11e+03": "1,110", "8192": "8,192", "1e-06": "1e-06", "0.42": "0.42", "nan": "", "direct": "direct"}
    assert {text: plain(text) for text in cells} == cells


def test_quick_leaves_out_sizes_unless_their_system_is_given(monkeypatch, tmp_path, capfd):
    from benchmarks import __main__ as runner

    large = runner.Study("scaling", "cardan", "no_such_package", quick=False)
    monkeypatch.setattr(runner, "STUDIES", (large,))
    assert runner.main(["--quick", "--out", str(tmp_path)]) == 0
    assert "no_such_package" not in capfd.readouterr().out
    assert runner.main(["--quick", "--out", str(tmp_path), "cardan"]) == 0
    assert "no_such_package" in capfd.readouterr().out


def test_bench_outside_a_checkout_is_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(drivetrain_jax, "__file__", str(tmp_path / "drivetrain_jax" / "__init__.py"))
    assert cli.main(["bench", "--quick"]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "benchmarks/" in message


def test_an_unknown_system_is_refused_before_anything_runs(capfd):
    assert cli.main(["bench", "bycicle", "--out", str(Path("nowhere"))]) == 2
    message = capfd.readouterr().err
    assert message.count("\n") == 1 and "bycicle" in message
    assert not Path("nowhere").exists()


def test_the_page_is_written_without_a_peer_or_a_study(monkeypatch, tmp_path, capfd):
    from benchmarks import __main__ as runner

    studies = (runner.Study("throughput", "cardan", "no_such_package"), runner.Study("no_such_study", "cardan"))
    monkeypatch.setattr(runner, "STUDIES", studies)
    assert runner.main(["--quick", "--out", str(tmp_path / "results"), "cardan"]) == 1
    out = capfd.readouterr().out
    assert "no_such_package" in out and "no_such_study" in out
    assert not_measured("throughput") in (tmp_path / "results" / "benchmarks.md").read_text()
    assert runner.main(["--quick", "--out", str(tmp_path / "other"), "tripod"]) == 0


def test_every_study_is_a_module_of_the_benchmarks():
    from benchmarks.__main__ import ROOT, STUDIES, SYSTEMS

    assert all((ROOT / "benchmarks" / f"{study.module}.py").is_file() for study in STUDIES)
    assert {study.system for study in STUDIES} == set(SYSTEMS)
