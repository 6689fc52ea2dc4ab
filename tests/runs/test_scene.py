"""Reading and checking scenes."""

from __future__ import annotations

import math
import re

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from drivetrain_jax import InputError
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.scene import load_scene

GOOD = {"system": "toy", "analysis": "toy", "axes": {"a": {"start": 0, "stop": 1, "num": 3}}}

HISTORY = {"system": "tripod", "analysis": "history", "fixed": {"element": "input", "beta": 0.1, "zeta": 0.01}}
TWO_SEGMENTS = {"length": [1.0, 1.0], "EI": [1.0, 1.0], "rhoA": [1.0, 1.0], "k_A": 1.0, "k_D": 1.0}
SHAFT = {"system": "bicardan", "analysis": "critical_speeds", "fixed": TWO_SEGMENTS}


def changed(**changes):
    return GOOD | changes


def follow(**changes):
    axes = {"length[0]": {"values": [1.0, 2.0]}}
    return {"system": "toy", "analysis": "follow", "axes": axes, "options": {"track": "length[0]"}} | changes


def test_defaults_are_filled_in():
    scene = load_scene(GOOD)
    assert scene.request.outputs == ("value",)
    assert scene.request.method == "plain" and scene.request.options == {"rtol": 1e-10}
    assert scene.fixed == {"b": 2.0, "n": 3, "kind": "plain", "length": (1.0, 2.0, 3.0)}
    assert scene.title == "Toy: toy analysis"


def test_unused_parameter_is_recorded():
    assert load_scene(changed(fixed={"unused": 7})).fixed["unused"] == 7.0


@pytest.mark.parametrize(
    ("axis", "expected"),
    [
        ({"start": 1, "stop": 9, "num": 5}, [1, 3, 5, 7, 9]),
        ({"start": 9, "stop": 1, "num": 3}, [9, 5, 1]),
        ({"start": 1, "stop": 9, "num": 5.0}, [1, 3, 5, 7, 9]),
        ({"start": 0.01, "stop": 1, "num": 3, "scale": "log"}, [0.01, 0.1, 1.0]),
        ({"values": [3, 1, 2.5]}, [3, 1, 2.5]),
        ({"start": 4, "stop": 4, "num": 1}, [4]),
    ],
)
def test_axis_values(axis, expected):
    np.testing.assert_allclose(load_scene(changed(axes={"a": axis})).axes[0].values, expected, rtol=1e-15)


def test_mapping_may_hold_numpy_values():
    scene = load_scene({**GOOD, "axes": {"a": {"values": np.linspace(0, 1, 3)}}, "fixed": {"b": np.float64(1.5)}})
    assert scene.axes[0].values.tolist() == [0, 0.5, 1] and scene.fixed["b"] == 1.5


@pytest.mark.parametrize(
    "values", [xr.DataArray([0.0, 0.5, 1.0]), xr.DataArray([0.0, 0.5, 1.0]).to_series(), range(3), (0.0, 0.5, 1.0)]
)
def test_mapping_may_hold_sequences(values):
    scene = load_scene({**GOOD, "axes": {"a": {"values": values}}, "fixed": {"b": xr.DataArray(1.5)}})
    assert scene.axes[0].values.tolist() == list(values) and scene.fixed["b"] == 1.5


@pytest.mark.parametrize(
    "values",
    [
        np.linspace(0, 1, 3),
        jnp.linspace(0, 1, 3),
        xr.Dataset(coords={"a": [0.0, 0.5, 1.0]})["a"],
        xr.Dataset(coords={"a": [0.0, 0.5, 1.0]}).indexes["a"],
        [0, np.float32(0.5), 1.0],
        (0.0, 0.5, 1.0),
    ],
    ids=lambda values: type(values).__name__,
)
def test_an_axis_may_be_a_row_of_values(tmp_path, values):
    scene = load_scene({**GOOD, "axes": {"a": values}})
    assert scene.axes[0].values.tolist() == [0, 0.5, 1]
    # The text of a scene is that of a scene file, whatever its source.
    assert "a = [0.0, 0.5, 1.0]" in scene.text.replace("[0,", "[0.0,")
    changed = load_scene(GOOD, {"axes.a": values})
    assert changed.axes[0].values.tolist() == [0, 0.5, 1] and changed.text == scene.text
    assert load_scene({**GOOD, "axes": {"a": range(3)}}).axes[0].values.tolist() == [0, 1, 2]


def test_text_of_a_changed_scene_gives_that_scene(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text('system="toy"\nanalysis="toy"\n[axes]\na={start=0,stop=1,num=3}\n"length[1]"={values=[1,2]}\n')
    assert load_scene(path).text == path.read_text()
    scene = load_scene(path, {"fixed.b": 4.5, "axes.a.num": 5, "title": 'quote " and \\ and é', "options.rtol": 1e-7})
    path.write_text(scene.text)
    again = load_scene(path)
    assert again.fixed == scene.fixed and again.title == scene.title and again.request == scene.request
    assert [a.name for a in again.axes] == ["a", "length[1]"] and len(again.axes[0].values) == 5


@pytest.mark.parametrize(
    ("given", "of"),
    [
        ({"outputs": None}, lambda s: s.request.outputs == ("value",)),
        ({"axes": {"a": {"start": 0, "stop": 1, "num": 3, "scale": None, "values": None}}}, lambda s: len(s.axes) == 1),
        ({"title": "\x7f, \x01 and \t"}, lambda s: s.title == "\x7f, \x01 and \t"),
    ],
)
def test_text_of_a_mapping_is_its_scene(tmp_path, given, of):
    """Other processes and growing results have only the text of a scene."""
    path, scene = tmp_path / "s.toml", load_scene(changed(**given))
    path.write_text(scene.text)
    assert of(scene) and of(load_scene(path)) and load_scene(path, {"outputs": None}).request == scene.request


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.5", 0.5),
        (".3", 0.3),
        ("5", 5),
        ("[1, 2]", [1, 2]),
        ('"x"', "x"),
        ("diffrax", "diffrax"),
        ("true", True),
        ("9" * 5000, math.inf),
        ("[" * 5000, "[" * 5000),
        ("[" * 5000 + "]" * 5000, "[" * 5000 + "]" * 5000),
    ],
)
def test_values_on_the_command_line(text, value):
    parsed = toml.parse_value(text)
    assert parsed == value and type(parsed) is type(value)


WRONG = {
    "unknown key": (changed(axis={}), "axis", "axes"),
    "missing system": ({"analysis": "toy"}, "system", "missing required field"),
    "unknown system": (changed(system="tooy"), "tooy", "cardan"),
    "unknown analysis": (changed(analysis="ty"), "ty", "unknown to toy (did you mean toy?); expected one of toy, slow"),
    "analysis of another system": (changed(system="cardan", analysis="toy"), "toy", "floquet"),
    "wrong type of a key": (changed(title=3), "title = 3", "expected `str`"),
    "wrong type of outputs": (changed(outputs=3), "outputs = 3", "expected `array | null`"),
    "unknown output": (changed(outputs=["valu"]), "valu", "did you mean value?"),
    "no output": (changed(outputs=[]), "outputs = []", "value"),
    "output twice": (changed(outputs=["value", "value"]), "outputs", "once"),
    "unknown parameter": (changed(fixed={"bb": 1}), "fixed.bb = 1", "did you mean b?"),
    "unknown axis": (changed(axes={"x": {"values": [1]}}), "axes.x", "expected a, b"),
    "missing parameter": (changed(axes={}), "fixed.a: missing", "0 <= a <= 10"),
    "parameter of the wrong type": (changed(fixed={"b": "two"}), "fixed.b = 'two'", "number"),
    "boolean for a number": (changed(fixed={"b": True}), "b = True", "number"),
    "parameter out of range": (changed(fixed={"b": 0}), "fixed.b = 0", "0 < b"),
    "not a number": (changed(fixed={"b": float("nan")}), "b = nan", "0 < b"),
    "infinite": (changed(fixed={"b": float("inf")}), "b = inf", "0 < b"),
    "beyond float": (changed(fixed={"b": 10**400}), "b: an integer of 1329 bits", "0 < b"),
    "not an integer": (changed(fixed={"n": 1.5}), "n = 1.5", "integer"),
    "unknown word": (changed(fixed={"kind": "odd"}), "kind = 'odd'", "plain, fancy"),
    "list entry out of range": (changed(fixed={"length": [1, -1]}), "length[1] = -1", "0 <= length"),
    "axis start out of range": (changed(axes={"a": {"start": -1, "stop": 1, "num": 3}}), "axes.a = -1", "0 <= a"),
    "axis stop out of range": (changed(axes={"a": {"start": 1, "stop": 11, "num": 3}}), "axes.a = 11", "a <= 10"),
    "axis value out of range": (changed(axes={"a": {"values": [1, 11]}}), "axes.a = 11", "a <= 10"),
    "axis with nan": (changed(axes={"a": {"values": [1, float("nan")]}}), "axes.a = nan", "0 <= a"),
    "empty axis": (changed(axes={"a": {"values": []}}), "axes.a.values = []", "one value or more"),
    "one point of two ends": (
        changed(axes={"a": {"start": 0, "stop": 1, "num": 1}}),
        "axes.a.num = 1: start = 0 and stop = 1 are two values",
        "expected num >= 2, or values = [0]",
    ),
    "no points on an axis": (changed(axes={"a": {"start": 0, "stop": 1, "num": 0}}), "axes.a.num = 0", "num >= 1"),
    "num of many digits": (
        changed(axes={"a": {"start": 0, "stop": 1, "num": 1e300}}),
        "axes: 100000000000000005250476025520442024870446858110815915491... points",
        "expected up to",
    ),
    "num not finite": (
        changed(axes={"a": {"start": 0, "stop": 1, "num": float("inf")}}),
        "axes.a.num = inf",
        "expected `int",
    ),
    "num of the wrong type": (
        changed(axes={"a": {"start": 0, "stop": 1, "num": 2.5}}),
        "axes.a.num = 2.5",
        "expected `int",
    ),
    "axis without num": (changed(axes={"a": {"start": 0, "stop": 1}}), "axes.a.num", "atlas"),
    "axis without stop": (changed(axes={"a": {"start": 0, "num": 3}}), "axes.a.stop: missing", "values"),
    "axis with everything": (changed(axes={"a": {"start": 0, "values": [1]}}), "axes.a", "one of the two"),
    "unknown key of an axis": (changed(axes={"a": {"begin": 0}}), "axes.a.begin", "start"),
    "axis of two dimensions": (
        changed(axes={"a": np.zeros((2, 2))}),
        "axes.a.values = [[0.0",
        "expected `int | float | str`",
    ),
    "axis that is one number": (changed(axes={"a": np.float64(0.5)}), "axes.a = 0.5", "row of values"),
    "axis that is no table": (changed(axes={"a": 3}), "axes.a = 3", "table"),
    "unknown scale": (changed(axes={"a": {"start": 1, "stop": 2, "num": 3, "scale": "ln"}}), "'ln'", "lin, log"),
    "log axis from zero": (changed(axes={"a": {"start": 0, "stop": 2, "num": 3, "scale": "log"}}), "start = 0", "> 0"),
    "value twice": (changed(axes={"a": {"values": [1, 2, 1]}}), "the value 1", "distinct"),
    "entry with a leading zero": (
        changed(axes={**GOOD["axes"], "length[1]": {"values": [1]}, "length[01]": {"values": [2]}}),
        "axes.length[01]",
        "unknown parameter",
    ),
    "entry in other digits": (changed(axes={"length[\u0661]": {"values": [1]}}), "axes.length[", "unknown parameter"),
    "entry of many digits": (changed(axes={f"length[{'9' * 5000}]": {"values": [1]}}), "axes.", "unknown parameter"),
    "axis without extent": (changed(axes={"a": {"start": 1, "stop": 1, "num": 2}}), "the value 1", "distinct"),
    "integer axis between integers": (
        changed(axes={**GOOD["axes"], "n": {"start": 1, "stop": 2, "num": 3}}),
        "n = 1.5",
        "integer",
    ),
    "word as axis": (changed(axes={"kind": {"values": [1]}}), "axes.kind", "fix it"),
    "list of another length": (
        follow(fixed={"b": 1.0, "weight": [1, 2]}),
        "fixed.weight = [1.0, 2.0]: 2 entries",
        "equally",
    ),
    "result that this system lacks": (
        {"system": "cardan", "analysis": "floquet", "outputs": ["floquet_exponents"]},
        "'floquet_exponents'",
        "expected floquet_multiplier, floquet_multiplier_error, spectral_radius,",
    ),
    "method that this system lacks": (
        {"system": "tripod", "analysis": "floquet", "options": {"method": "magic"}},
        "options.method = 'magic'",
        "expected auto, direct, diffrax",
    ),
    "num beside times": (
        {**HISTORY, "options": {"times": [0.0, 1.0], "num": 5}},
        "options.num = 5",
        "given together with times",
    ),
    "entry of a list that is not given": (
        {**SHAFT, "axes": {"k_joint[0]": {"values": [1e6]}}},
        "fixed.k_joint: missing",
        "k_joint[0] varies one entry",
    ),
    "entry beyond the list among points": (
        {**SHAFT, "points": {"length[2]": [1.0]}},
        "points.length[2]",
        "length[0] to length[1]",
    ),
    "long list for a number": (changed(fixed={"b": [0.5] * 1000}), "fixed.b = [0.5, 0.5,", "...: expected"),
    "list of one": (
        {"system": "planetary", "analysis": "modes", "fixed": {"planet_angle": [0.0, 2.0], "m_p": [1.0]}},
        "fixed.m_p = [1.0]: 1 entry where planet_angle has 2",
        "one entry per planet",
    ),
    "entry of a number for all": (
        follow(axes={"weight[0]": {"values": [1]}}, fixed={"b": 1.0}),
        "fixed.weight = 1.0",
        "list",
    ),
    "path that is no axis": (follow(options={"track": "c"}), "options: 'c'", "expected one of length[0]"),
    "path that is a number": (follow(options={"track": 3}), "options.track = 3", "text"),
    "no infinity": (changed(fixed={"b": math.inf}), "fixed.b = inf", "0 < b"),
    "whole list as axis": (changed(axes={"length": {"values": [1]}}), "axes.length", '"length[0]"'),
    "entry of a number": (changed(axes={"a[0]": {"values": [1]}}), "axes.a[0]", "not a list"),
    "entry beyond the list": (changed(axes={**GOOD["axes"], "length[3]": {"values": [1]}}), "length[3]", "length[2]"),
    "axis and fixed": (changed(fixed={"a": 1}), "fixed.a = 1", "also in [axes]"),
    "axes and points": (changed(points={"a": [1]}), "points", "one of the two"),
    "points of different length": (
        {**GOOD, "axes": {}, "points": {"a": [1, 2], "b": [1]}},
        "a has 2, b has 1",
        "one length",
    ),
    "no points": ({**GOOD, "axes": {}, "points": {"a": []}}, "a has 0", "at least 1"),
    "points that are no list": ({**GOOD, "axes": {}, "points": {"a": 1}}, "points.a = 1", "list"),
    "point out of range": ({**GOOD, "axes": {}, "points": {"a": [1, 11]}}, "points.a = 11", "a <= 10"),
    "path among points": ({"system": "toy", "analysis": "line", "points": {"a": [1], "b": [1]}}, "points.b", "path"),
    "unknown method": (changed(options={"method": "magic"}), "options.method = 'magic'", "plain, other"),
    "unknown option": (changed(options={"rtl": 1}), "options.rtl = 1", "did you mean rtol?"),
    "option of another method": (
        changed(options={"knob": 1.0}),
        "options.knob",
        "not used by method plain, but by other;",
    ),
    "option out of range": (changed(options={"rtol": 1.0}), "options.rtol = 1.0", "0.01"),
    "bytes": (changed(title=b"x"), "title = b'x'", "expected `str`"),
    "number for a scene": (5, "scene = 5", "path of a scene file"),
    "nothing": (None, "scene = None", "path of a scene file"),
    "too many points": (
        changed(axes={n: {"start": 1, "stop": 2, "num": 10**6} for n in ("a", "b")}),
        "1000000000000 points",
        "2000000000",
    ),
}


CHAIN = {"k": [1e4, 2e4], "J": [0.1, 0.2], "c": [1.0, 1.0], "speed": 10.0, "beta": [0.1, 0.2]}
NO_RATIO = "fixed.ratio[1] = 0: expected a ratio other than 0"
NO_MASS = "expected 0 for a segment without mass (rhoA[0] = 0)"


@pytest.mark.parametrize(
    ("scene", "fixed", "axes", "message"),
    [
        ({"system": "driveline", "analysis": "floquet"}, CHAIN | {"ratio": [1, 1]}, {"ratio[1]": [-1, 0, 1]}, NO_RATIO),
        (SHAFT, TWO_SEGMENTS | {"rhoI": [1e-3, 1e-3]}, {"rhoA[0]": [0, 1]}, NO_MASS),
        (SHAFT, TWO_SEGMENTS | {"rhoA": [0, 1]}, {"rhoI": [0, 1e-3]}, NO_MASS),
        (SHAFT, TWO_SEGMENTS, {"length[0]": [1.0, 2.0]}, ""),
    ],
)
def test_values_that_do_not_go_together_are_refused_where_they_vary(scene, fixed, axes, message):
    scene = {**scene, "fixed": fixed, "axes": axes}
    if not message:
        load_scene(scene)
        return
    with pytest.raises(InputError, match=re.escape(message)):
        load_scene(scene)


def test_a_quotient_may_be_a_value_of_an_axis():
    scene = {"system": "driveline", "analysis": "floquet", "fixed": CHAIN | {"ratio": [1, 1]}}
    (axis,) = load_scene(scene | {"axes": {"ratio[0]": ["1/2", "1/0.78"]}}).axes
    assert axis.values.tolist() == [1 / 2, 1 / 0.78]


def test_an_integer_is_no_rounded_number():
    with pytest.raises(InputError, match=r"axes\.n = .*: expected integers up to 2\^53"):
        load_scene(changed(axes={"n": [1, 2**70]}))


@pytest.mark.parametrize("case", WRONG)
def test_wrong_scene_is_one_clear_line(case):
    scene, field, allowed = WRONG[case]
    with pytest.raises(InputError) as error:
        load_scene(scene)
    message = str(error.value)
    assert field in message and allowed in message and "\n" not in message


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (b"a = " + b"9" * 5000, "not valid TOML: Exceeds the limit"),
        (b"a = [1", "not valid TOML: .*at end of document"),
        (b"\xff\xfe", "UTF-8"),
        (None, "No such file"),
        (b"a = 1\nb = x", "at line 2, column 5.; words and numbers with units stand in quotes"),
        (b"a = " + b"[" * 5000 + b"]" * 5000, "not valid TOML: maximum recursion"),
    ],
)
def test_wrong_file_is_one_clear_line(tmp_path, content, part):
    path = tmp_path / "s.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=part):
        load_scene(path)


@pytest.mark.parametrize("overrides", [{5: 1}, {"": 1}, [1], "fixed.a"])
def test_wrong_overrides_are_one_clear_line(overrides):
    with pytest.raises(InputError, match=r"overrides = .*expected a table by dotted keys"):
        load_scene(GOOD, overrides)


def test_a_byte_order_mark_and_line_ends_of_windows_are_read(tmp_path):
    path, text = tmp_path / "s.toml", toml.write(GOOD)
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert load_scene(path).axes[0].values.tolist() == load_scene(GOOD).axes[0].values.tolist()


def test_huge_axis_is_refused_before_it_is_created():
    with pytest.raises(InputError, match="expected up to 2000000000"):
        load_scene(changed(axes={"a": {"start": 0, "stop": 1, "num": 10**15}}))
