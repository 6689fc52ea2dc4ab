"""Tables that the documentation takes from the code."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import generated

pytestmark = pytest.mark.docs


def test_a_page_lists_what_its_system_offers():
    cardan, tripod = generated.analyses("cardan"), generated.analyses("tripod")
    assert "`floquet_exponent`" not in cardan and "`atlas` (rtol)" in cardan
    assert "`floquet_exponent`" in tripod and "`atlas` (rtol)" not in tripod


def test_sets_of_values_are_exact_and_lists():
    assert "`EI = [64427.19309119694, 22156.511704062643, 8349.76422461912]`" in generated.parameters("bicardan")


@pytest.mark.parametrize("page", generated.pages(), ids=lambda page: page.stem)
def test_committed_tables_are_those_of_the_code(page):
    text = page.read_text()
    assert "<!-- generated: " in text
    assert generated.written(text) == text, "run `python docs/generated.py`"
