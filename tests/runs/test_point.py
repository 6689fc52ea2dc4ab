"""One point: values, units, a readable answer."""

from __future__ import annotations

import copy
import json
import pickle
import re

import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.atlas import proof
from drivetrain_jax.runs import kernel
from drivetrain_jax.runs import point as point_module
from drivetrain_jax.runs.reply import Limit


def test_results_by_attribute_and_name():
    result = dt.point("toy", "toy", a=1.0, outputs=["value", "wave", "sign"])
    assert result.value == result["value"] == 328.0 and result.sign == 0
    assert result.wave.dtype == complex and result.wave.shape == (3,)
    assert result.units == {"value": "m", "wave": "1", "sign": "1"}
    assert result.outcome == 0 and result.outcome.has_value and list(result) == ["value", "wave", "sign"]
    assert result.parameters["b"] == 2.0 and result.parameters["a"] == 1.0
    with pytest.raises(AttributeError, match="there is value, wave, sign"):
        result.nothing  # noqa: B018
    with pytest.raises(AttributeError):
        result.value = 3


def test_same_value_as_in_a_sweep():
    ds = dt.run(
        {"system": "toy", "analysis": "toy", "axes": {"a": {"values": [0.3, 6.1]}, "b": {"values": [1.0, 1.7]}}}
    )
    for a, b in [(0.3, 1.7), (6.1, 1.0)]:
        assert dt.point("toy", "toy", a=a, b=b).value == pytest.approx(float(ds["value"].sel(a=a, b=b)), rel=1e-14)


def test_readable():
    text = repr(dt.point("toy", "toy", a=6.0, b=1.5, outputs=["value", "sign"]))
    assert text.splitlines() == [
        "toy toy (method plain), a = 6 m, b = 1.5 s, n = 3, kind = plain, length = [1, 2, 3] m",
        "  value   = 331.5 m",
        "  sign    = large (1)",
        "  outcome = success",
    ]


@pytest.mark.full
def test_errors_have_three_digits():
    found = dt.point("planetary", "modes", outputs=["natural_frequency", "natural_frequency_error"])
    first = repr(found).splitlines()[3].split()
    assert first[1:] == [f"{found.natural_frequency[0]:.12g}", f"{found.natural_frequency_error[0]:.3g}"]


def test_physical_units():
    data = {"J1": 2.0, "J2": 200.0, "k1": 1000.0, "k2": 1500.0, "c1": 0.1, "c2": 0.05}
    found = dt.point("cardan", "floquet", **data, speed=300.0, angle=18.0)
    exact = dt.point("cardan", "floquet", **dt.Cardan.from_physical(**data, speed=300.0, angle=18.0).values)
    assert found.parameters.items() <= exact.parameters.items() and found.spectral_radius == exact.spectral_radius
    assert json.loads(found.to_json())["physical"]["speed"] == {"value": 300.0, "units": "rpm"}
    assert re.match(r"Stable; decay [\d.]+ 1/s, by a factor 0\.\d+ per turn; halves in ", repr(found))
    assert "(method auto), J1 = 2 kg m2, " in repr(found) and "  that is beta = 0.314159 rad, " in repr(found)
    assert "physical" not in json.loads(exact.to_json())
    for given, message in (
        ({"J1": 2.0, "speed": 300.0}, "k1: missing; Omega = speed sqrt(J1/k1) needs k1"),
        ({**data, "speed": "fast", "angle": 1.0}, "speed = 'fast': expected a number, 0 < speed < inf"),
        (
            {**data, "speed": 300.0, "angle": 18.0, "zeta": 0.4},
            "zeta = 0.4: given besides c1, J1, k1; expected one of the two",
        ),
        ({**data, "angle": 90.0, "speed": 1.0}, "angle = 90.0: expected -90 < angle < 90, in deg"),
    ):
        with pytest.raises(dt.InputError, match=f"^{re.escape(message)}$"):
            dt.point("cardan", "floquet", **given)


def test_angles_of_planets_in_degrees_are_refused():
    with pytest.raises(
        dt.InputError, match=r'^planet_angle\[1\] = 120: expected .*, in rad; did you mean "120 deg"\?$'
    ):
        dt.point("planetary", "modes", planet_angle=[0, 120, 240])


def test_one_output_may_be_a_word():
    assert list(dt.point("toy", "toy", a=6.0, outputs="sign")) == ["sign"]
    with pytest.raises(dt.InputError, match="outputs: 'all' is not a result of toy"):
        dt.point("toy", "toy", a=6.0, outputs="all")


@pytest.mark.full
def test_lists_are_printed_side_by_side():
    result = dt.point("planetary", "modes", outputs=["natural_frequency", "mode_type"])
    lines = repr(result).splitlines()
    assert lines[1] == "  outcome = success" and lines[2].split() == ["mode", "natural_frequency", "[Hz]", "mode_type"]
    assert len(lines) == 3 + 21
    number, frequency, *kind = lines[8].split()
    assert (number, kind) == ("6", ["rotational", "(1)"])
    assert float(frequency) == pytest.approx(float(result.natural_frequency[5]), rel=1e-11)
    assert list(result.labels["mode"]) == list(range(1, 22))


def test_failed_point_says_so():
    result = dt.point("toy", "toy", a=9.5)
    assert np.isnan(result.value) and not result.outcome.has_value and "not_finite" in repr(result)
    assert json.loads(result.to_json())["values"]["value"] == {"value": None, "units": "m"}


def test_a_result_can_be_copied_and_pickled():
    result = dt.point("toy", "toy", a=1.0)
    for again in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result), copy.copy(result)):
        assert again.value == result.value and repr(again) == repr(result)
    with pytest.raises(AttributeError, match="no result 'valu'; there is value"):
        result.valu  # noqa: B018


def test_json():
    answer = json.loads(dt.point("toy", "toy", a=0.0, outputs=["wave"]).to_json())
    assert answer["values"]["wave"]["value"] == {"real": [1.0, 1.0, 1.0], "imag": [0.0, 0.0, 0.0]}
    assert answer["outcome"] == "success" and answer["parameters"]["a"] == {"value": 0.0, "units": "m"}
    result = dt.point("toy", "toy", a=6.0, outputs=["value", "sign"])
    assert json.loads(result.to_json())["values"]["sign"] == {"value": 1, "units": "1", "meaning": "large"}
    assert dict(result) == {"value": result.value, "sign": 1}


def test_texts_lists_and_options():
    assert dt.point("toy", "toy", a=1.0, kind="fancy", length=[1.0], method="other", knob=2.0).value == 8.5


def test_a_line_of_one_value():
    assert dt.point("toy", "line", a=2.0, b=3.0).response.tolist() == [6.0, 3.0]


def test_another_point_needs_no_new_compilation():
    dt.point("toy", "toy", a=1.0, b=1.0)
    before = kernel._compiled.cache_info()
    dt.point("toy", "toy", a=2.0, b=1.5)
    after = kernel._compiled.cache_info()
    assert after.hits == before.hits + 1 and after.misses == before.misses


@pytest.mark.parametrize(
    ("given", "part"),
    [
        ({"a": 11}, "^a = 11: expected 0 <= a <= 10, in m$"),
        ({"a": "x"}, "^a = 'x': expected a number"),
        ({"a": [1.0]}, "^a = "),
        ({}, "^a: missing"),
        ({"a": 1, "c": 2}, "^c = 2: unknown; expected a, b"),
        ({"a": 1, "rtol": 2}, "^rtol = 2"),
        ({"a": 1, "knob": 2}, "^knob = 2: not used by method plain"),
        ({"a": 1, "kind": "odd"}, "^kind = 'odd'"),
        ({"a": 1, "outputs": ["nothing"]}, "^outputs: 'nothing'"),
        ({"a": 1, "outputs": 5}, "^outputs = 5: expected `array"),
        ({"a": 1, "outputs": True}, "^outputs = True: expected `array"),
        ({"a": 1j}, "^a = 1j: expected `int"),
    ],
)
def test_wrong_input_is_one_clear_line(given, part):
    with pytest.raises(dt.InputError, match=part):
        dt.point("toy", "toy", **given)


def test_unknown_system_and_analysis():
    with pytest.raises(dt.InputError, match="system = 'tractor'"):
        dt.point("tractor", "toy")
    with pytest.raises(dt.InputError, match=r"system = 'mine': unknown; .*dt\.register"):
        dt.point("mine", "toy")
    with pytest.raises(dt.InputError, match="analysis = 'dance'"):
        dt.point("toy", "dance")
    with pytest.raises(dt.InputError, match="system = 5"):
        dt.point(5, "toy")
    with pytest.raises(dt.InputError, match="analysis = 5"):
        dt.point("toy", 5)


def test_a_function_has_no_value_at_one_point():
    names = "floquet, history, lyapunov, forced, frequency_response"
    message = f"analysis = 'atlas': needs ranges; expected at a point one of {names}"
    with pytest.raises(dt.InputError, match=f"^{message}$"):
        dt.point("cardan", "atlas", beta=0.3)


@pytest.mark.full
def test_a_matrix_is_printed_with_its_rows_and_columns():
    shaft = {"length": [0.07, 0.59, 0.25], "EI": [64427.0, 22157.0, 8350.0], "rhoA": [15.3, 2.81, 5.51]}
    shape = dt.point("bicardan", "critical_speeds", **shaft, k_A=85e6, k_D=2e7, modes=2, outputs=["mode_shape"])
    lines = repr(shape).splitlines()
    assert lines[-len(shape.labels["x"]) - 1].split() == ["x", "mode", "1", "mode", "2"]
    assert [float(cell) for cell in lines[-1].split()] == pytest.approx(
        [shape.labels["x"][-1], *shape.mode_shape[:, -1]]
    )


def test_one_entry_of_a_list_is_given_alone():
    lists = {"beta": [0.1, 0.2], "k": np.array([1.0, 2.0])}
    found = dt.point("driveline", "phasing", **lists, **{"beta[1]": "20 deg", "k[0]": 3.0})
    assert found.parameters["k"] == (3.0, 2.0)
    assert found.parameters["beta"] == pytest.approx((0.1, np.radians(20)), rel=1e-15)
    few = "an entry of the list beta, which has 2"
    cases = (
        ("beta[2]", lists, few),
        ("foo[0]", {}, "the list foo beside it"),
        ("speed[0]", {"speed": 3.0}, "the list speed"),
    )
    for name, given, allowed in cases:
        with pytest.raises(dt.InputError, match=f"expected {allowed}"):
            dt.point("driveline", "phasing", **given, **{name: 0.3})


@pytest.mark.full
def test_a_range_of_a_number_without_unit():
    found = dt.point("cardan", "floquet", beta=0.3, Omega=(1.3, 1.5), zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    assert found.sentence.startswith(
        "Unstable at Omega = 1.40025 to 1.43236 (S21); the rest of Omega = 1.3 to 1.5 is stable."
    )


def test_the_verdict_of_another_analysis_is_not_that_of_stability(monkeypatch):
    """`lyapunov` has codes of its own: 0 is a fixed point, 3 an unstable equilibrium."""
    shaft = {"beta": 0.3, "Omega": 1.4, "zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    solved = {"amplitude": np.array([0.01, 0.01]), "verdict": 1}
    monkeypatch.setattr(point_module, "point", lambda *_, outputs, **__: {outputs[0]: solved[outputs[0]]})
    monkeypatch.setattr(proof, "verdict_at", lambda *_: 0)
    limit = Limit.from_text(dt.Cardan, "2 deg")
    for analysis, code, within, proved in (
        ("lyapunov", 3, False, False),
        ("lyapunov", 0, False, False),
        ("floquet", 0, True, True),
    ):
        result = point_module.PointResult("cardan", analysis, "", shaft, {"verdict": code}, Outcome.SUCCESS, {}, {}, {})
        assert result.proved is proved
        assert point_module._forced(result, shaft, limit)[1]["within"] is within
