"""The measured part of docs/theory/atlas.md is what the stored file gives; a case without a row says so."""

from __future__ import annotations

import pytest

from benchmarks import atlas_attack
from benchmarks.measure import RESULTS
from benchmarks.page import ATLAS_PAGE, atlas_part, between_marks

pytestmark = pytest.mark.docs

ROW = {
    "case": "four", "beta": "0..1.3", "Omega": "0.2..2.5", "zeta": "0.001", "alpha": "0.1..20", "mu": "0.2..20",
    "tolerance": "2e-09", "panels": "16x39x32x8 4x5x6x7", "gaps": 0, "solves": 160416, "bytes": 6112345, "z_error": 4e-11,
    "rho_error": 5.7e-10, "cells": 10_000, "worst": 50, "random_direct": 0.0012, "nearest_direct": 0.3,
    "widest_direct": 0.0, "violations_direct": 1, "wrong_direct": 0, "random_precise": 0.0013, "nearest_precise": 0.25,
    "widest_precise": 0.5, "violations_precise": 2, "wrong_precise": 4, "undecided": 12, "of": 1_000_000,
}  # fmt: skip


def test_the_measured_part_is_what_the_stored_file_gives(tmp_path):
    text = ATLAS_PAGE.read_text()
    assert between_marks(text, atlas_part(RESULTS)) == text, "run `python -m benchmarks.page`"
    assert atlas_part(tmp_path) == "Not measured: `atlas_attack.csv` is missing."


def test_a_case_alone_keeps_the_rows_of_the_others(tmp_path):
    for row in (ROW | {"solves": 1}, ROW | {"case": "base", "mu": "1"}, ROW):
        atlas_attack.write(tmp_path, row)
    lines = atlas_part(tmp_path).splitlines()
    base, four = [line for line in lines if "160,416" in line]
    assert "mu 1 |" in base and "mu 0.2..20 |" in four
    assert "| 2e-09 | 16x39x32x8 4x5x6x7 | 160,416 | 6.1 MB | 4.0e-11 |" in four
    assert "| 5.7e-10 | 0.0013 | 0.3 | 0.5 | 12 of 1,000,000 | 3 | 4 |" in atlas_part(tmp_path)


def test_labels_tell_the_cases_apart():
    labels = {line.split(" | ")[0] for line in atlas_part(RESULTS).splitlines() if line.startswith("| beta")}
    assert len(labels) == len({case.name for case in atlas_attack.CASES}) == 9
