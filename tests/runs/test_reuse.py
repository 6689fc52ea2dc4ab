"""Larger scenes reuse the points of smaller ones: which points, which values, and which results are refused."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import xarray as xr
from interrupts import stop_after

import drivetrain_jax as dt
from drivetrain_jax import InputError
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.output import status
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.reuse import _same_points, equal_codes
from drivetrain_jax.runs.run import Interrupted, run_to_file
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.runs.work import Threads
from drivetrain_jax.store import checksums
from tests.sizes import full_after

pytestmark = pytest.mark.usefixtures("small_blocks")


NAMES = ["value", "wave", "sign"]


def scene(axes, fixed=None, **more):
    axes = {name: value if isinstance(value, dict) else {"values": value} for name, value in axes.items()}
    kept = {"system": "toy", "analysis": "toy", "outputs": NAMES, "axes": axes, "fixed": fixed or {}}
    return kept | more


def opened(path):
    with xr.open_dataset(path, engine="h5netcdf") as ds:
        return ds.load()


def counts(progress):
    return progress.total, progress.computed, progress.reused


def agree(path, large):
    """The grown result equals that of a single run, in every number that does not depend on neighbours."""
    grown, alone = opened(path), dt.run(large)
    for name in (*NAMES, "outcome", *alone.coords):
        np.testing.assert_array_equal(grown[name].values, alone[name].values, err_msg=name)
        assert grown[name].dims == alone[name].dims
    return grown


SMALL = scene({"b": [1.0, 3.0], "a": {"start": 0.0, "stop": 10.0, "num": 11}})


@pytest.mark.parametrize(
    ("large", "new"),
    full_after(
        3,
        [
            (scene({"b": [1.0, 3.0, 2.0], "a": {"start": 0.0, "stop": 10.0, "num": 11}}), 11),
            (scene({"b": [1.0, 3.0], "a": {"start": 0.0, "stop": 10.0, "num": 21}}), 20),
            (scene({"b": [1.0, 3.0], "a": {"start": 0.0, "stop": 10.0, "num": 31}}), 40),
            (scene({"a": {"start": 0.0, "stop": 10.0, "num": 11}, "b": [3.0, 1.0]}), 0),
            (scene(SMALL["axes"] | {"n": [2, 3]}), 22),
            (scene(SMALL["axes"] | {"unused": [5.0]}), 0),
        ],
        several=True,
    ),
    ids=["longer", "finer", "finer by three", "other order", "one more axis", "an axis that is not used"],
)
def test_only_new_points_are_computed(tmp_path, large, new):
    path = tmp_path / "r.nc"
    run_to_file(SMALL, path)
    total = 22 + new
    assert (status(large, path).state, status(large, path).done) == ("partial", 22)
    progress = run_to_file(large, path)
    assert counts(progress) == (total, new, 22) and progress.failed == int((opened(path).outcome >= 2).sum())
    assert agree(path, large).attrs["reused_points"] == 22
    assert status(large, path).state == "complete"
    assert counts(run_to_file(large, path)) == (total, 0, total)


@pytest.mark.parametrize(
    ("old", "new", "shared"),
    [
        ([1e-3, 1e16], [1e-3, 1.0, 1e16], 2),
        ([1e-3, 1e14], [0.02, 1e14], 1),
        ([1.0, 2.0, 1e16], [1.0, 2.5, 1e16], 2),
        ([1.0, 2.0, 1e16], [2.5], 0),
    ],
)
def test_distant_values_do_not_widen_the_tolerance_of_small_ones(tmp_path, old, new, shared):
    path, large = tmp_path / "r.nc", scene({"b": new}, {"a": 1.0})
    run_to_file(scene({"b": old}, {"a": 1.0}), path)
    if shared:
        assert run_to_file(large, tmp_path / "l.nc", reuse=[path]).reused == shared
        agree(tmp_path / "l.nc", large)
    else:
        with pytest.raises(InputError, match="none of the points"):
            run_to_file(large, tmp_path / "l.nc", reuse=[path])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (np.linspace(-1, 1, 7), np.linspace(-1, 1, 31)),
        (np.linspace(0, 1, 11), np.linspace(-1, 1, 21)),
        (np.linspace(-0.3, 0.6, 10), np.linspace(0.6, -0.3, 91)),
        (np.geomspace(1e-9, 1e9, 7), np.geomspace(1e-9, 1e9, 37)),
        (np.linspace(-1, 1, 21), np.array([0.0])),
    ],
)
def test_axis_values_equal_to_rounding_are_the_same(old, new):
    few, many = sorted((old, new), key=len)
    for codes in (equal_codes(few, many), equal_codes(many, few)[::-1]):
        assert np.isin(*codes).all() and len({*codes[1]}) == len(many)


def test_nothing_is_near_to_infinity():
    few, many = equal_codes(np.array([85e6]), np.array([85e6, np.inf, np.inf]))
    assert few[0] == many[0] != many[1] == many[2]


def test_many_parameters_of_many_values_make_different_points():
    """The number of possible points, 2^64 and more, is no integer of 64 bits."""
    count = 1 << 16
    values = {name: 1 + np.random.default_rng(i).permutation(count) / count for i, name in enumerate(("a", "b"))}
    values |= {f"length[{i}]": values["b"][::-1] + i for i in range(3)}
    small = {"system": "toy", "analysis": "toy", "fixed": {"length": [1.0, 2.0, 3.0]}, "points": values}
    # The second half has another ``a``.
    other = values | {"a": values["a"] + 5 * (np.arange(count) >= count // 2)}
    one, job = load_scene(small), resolve(load_scene(small | {"points": other}))
    for numbers in _same_points(one, Grid.of(one), job):
        assert np.sort(numbers).tolist() == list(range(count // 2))


def test_values_are_reused_not_computed(tmp_path):
    """Marked values survive, so reused points were not computed again."""
    path = tmp_path / "r.nc"
    run_to_file(SMALL, path)
    with h5py.File(path, "r+") as file:
        file["value"][1, 3] = -7.0
        checksums.seal(file)
    run_to_file(scene({"b": [1.0, 3.0, 2.0], "a": {"start": 0.0, "stop": 10.0, "num": 21}}), path)
    assert opened(path)["value"].values[1, 6] == -7.0


def test_a_result_that_would_lose_points_is_not_replaced(tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(SMALL, path)
    before = path.read_bytes()
    part = scene({"b": [1.0], "a": {"start": 0.0, "stop": 10.0, "num": 41}})
    with pytest.raises(InputError, match=r"axes.b is 1 value at 1, was 2 values from 1 to 3"):
        run_to_file(part, path)
    assert path.read_bytes() == before and status(part, path).state == "stale"
    assert status(part, path).reason.endswith("--reuse r.nc with another --out takes 11 points from it")
    assert counts(run_to_file(part, tmp_path / "other.nc", reuse=[path])) == (41, 30, 11)
    agree(tmp_path / "other.nc", part)
    assert counts(run_to_file(part, path, fresh=True)) == (41, 41, 0)


def test_several_results_join(tmp_path):
    for name, b in (("one", [1.0, 2.0]), ("two", [2.0, 3.0])):
        run_to_file(scene({"b": b, "a": [1.0, 8.0]}), tmp_path / f"{name}.nc")
    whole = scene({"b": [1.0, 2.0, 3.0, 4.0], "a": [1.0, 8.0]})
    progress = run_to_file(whole, tmp_path / "r.nc", reuse=[tmp_path / "one.nc", tmp_path / "two.nc"])
    assert counts(progress) == (8, 2, 6)
    assert len(agree(tmp_path / "r.nc", whole).attrs["reused_from"].split()) == 2


def test_entries_of_lists_and_fixed_values(tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(scene({"a": [1.0, 6.0]}, {"length": [4.0, 5.0, 2.0]}), path)
    large = scene({"length[1]": [0.0, 5.0], "a": [1.0, 6.0]}, {"length": [4.0, 9.0, 2.0]})
    assert counts(run_to_file(large, path)) == (4, 2, 2)
    agree(path, large)
    other = scene({"length[1]": [0.0, 5.0], "a": [1.0, 6.0]}, {"length": [4.5, 9.0, 2.0]})
    with pytest.raises(InputError, match="holds none of the points"):
        run_to_file(other, tmp_path / "other.nc", reuse=[path])
    inner = scene({"a": [1.0]}, {"length": [4.0, 0.0, 2.0]})
    assert counts(run_to_file(inner, tmp_path / "inner.nc", reuse=[path])) == (1, 0, 1)


def test_lists_of_points(tmp_path):
    points = {"a": [1.0, 8.0, 3.0], "b": [1.0, 2.0, 1.0]}
    small = {"system": "toy", "analysis": "toy", "outputs": NAMES, "points": points}
    run_to_file(small, tmp_path / "r.nc")
    large = small | {"points": {"b": [1.0, 5.0, 2.0, 1.0], "a": [3.0, 1.0, 8.0, 1.0]}}
    assert counts(run_to_file(large, tmp_path / "r.nc")) == (4, 1, 3)
    agree(tmp_path / "r.nc", large)
    rounded = small | {"points": {"a": [np.nextafter(3.0, 4.0), np.nextafter(8.0, 9.0)], "b": [1.0, 1.0]}}
    assert counts(run_to_file(rounded, tmp_path / "rounded.nc", reuse=[tmp_path / "r.nc"])) == (2, 1, 1)
    grid = scene({"a": [1.0, 2.0], "b": [1.0, 5.0]})
    run_to_file(grid, tmp_path / "grid.nc")
    some = small | {"points": {"a": [1.0, 2.5], "b": [5.0, 5.0]}}
    assert counts(run_to_file(some, tmp_path / "some.nc", reuse=[tmp_path / "grid.nc"])) == (2, 1, 1)
    agree(tmp_path / "some.nc", some)
    # A grid takes the points of a list, one that occurs twice once.
    twice = small | {"points": {"a": [1.0, 1.0, 2.5], "b": [5.0, 5.0, 5.0]}}
    run_to_file(twice, tmp_path / "twice.nc")
    assert counts(run_to_file(grid, tmp_path / "g.nc", reuse=[tmp_path / "twice.nc", tmp_path / "r.nc"])) == (4, 2, 2)
    agree(tmp_path / "g.nc", grid)


def test_one_point_serves_a_list_with_that_point_twice(tmp_path):
    one = {"system": "toy", "analysis": "toy", "outputs": NAMES, "fixed": {"a": 3.0, "b": 1.0}}
    run_to_file(one, tmp_path / "one.nc")
    points = {
        "system": "toy",
        "analysis": "toy",
        "outputs": NAMES,
        "points": {"a": [3.0, 3.0, 4.0], "b": [1.0, 1.0, 2.0]},
    }
    assert counts(run_to_file(points, tmp_path / "r.nc", reuse=[tmp_path / "one.nc"])) == (3, 1, 2)
    agree(tmp_path / "r.nc", points)


ALONE = {"system": "toy", "analysis": "line"}


@pytest.mark.parametrize(
    ("small", "large"),
    [
        (ALONE | {"axes": {"b": {"values": [1.0, 4.0]}}, "fixed": {"a": 1.0}},
         ALONE | {"axes": {"b": {"values": [1.0, 4.0, 9.0]}}, "fixed": {"a": 1.0}}),
        (scene({}, {"a": 1.0}), scene({}, {"a": 2.0})),
    ],
    ids=["longer path", "no axes"],
)  # fmt: skip
def test_a_result_of_one_point_or_line_is_refused(tmp_path, small, large):
    path = tmp_path / "r.nc"
    run_to_file(small, path)
    with pytest.raises(InputError, match=r"another scene or version: (axes\.b|fixed\.a)"):
        run_to_file(large, path)
    assert status(large, path).state == "stale"
    with pytest.raises(InputError, match="holds none of the points"):
        run_to_file(large, tmp_path / "other.nc", reuse=[path])


@pytest.mark.parametrize("order", [("a", "b"), ("b", "a")])
def test_lines_are_reused_whole(tmp_path, order):
    path, b = tmp_path / "r.nc", [1.0, 4.0, 9.0]

    def line(**axes):
        return {"system": "toy", "analysis": "line", "axes": {name: {"values": axes[name]} for name in order}}

    run_to_file(line(a=[1.0, 2.0], b=b), path)
    large = line(a=[2.0, 3.0, 1.0], b=b)
    assert counts(run_to_file(large, path)) == (9, 3, 6) and opened(path).attrs["reused_points"] == 6
    xr.testing.assert_equal(opened(path), dt.run(large))
    with pytest.raises(InputError, match="another scene"):
        run_to_file(line(a=[1.0, 2.0, 3.0], b=[*b, 16.0]), path)
    with pytest.raises(InputError, match="takes 3 points from it"):
        run_to_file(line(a=[1.0], b=b), path)


def test_a_line_of_one_fixed_value(tmp_path):
    small = {"system": "toy", "analysis": "line", "axes": {"a": {"values": [1.0]}}, "fixed": {"b": 5.0}}
    run_to_file(small, tmp_path / "r.nc")
    large = small | {"axes": {"a": {"values": [1.0, 2.0]}}}
    assert counts(run_to_file(large, tmp_path / "r.nc")) == (2, 1, 1)
    xr.testing.assert_equal(opened(tmp_path / "r.nc"), dt.run(large))


LARGE = scene({"b": [1.0, 3.0], "a": {"start": 0.0, "stop": 10.0, "num": 161}})


def test_an_interrupted_growth_resumes_and_keeps_the_former_result(tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(SMALL, path)
    before, calls = path.read_bytes(), iter(range(3))

    def stop(progress):
        if next(calls, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        run_to_file(LARGE, path, executor=Threads(1), report=stop)
    assert path.read_bytes() == before
    done = stopped.value.progress.computed
    assert done > 0 and (status(LARGE, path).state, status(LARGE, path).done) == ("partial", 22 + done)
    assert counts(run_to_file(LARGE, path)) == (322, 300 - done, 22 + done)
    undisturbed = tmp_path / "u.nc"
    run_to_file(SMALL, undisturbed)
    run_to_file(LARGE, undisturbed)
    for name, variable in opened(path).variables.items():
        assert variable.values.tobytes() == opened(undisturbed)[name].values.tobytes()


def test_unfinished_work_is_resumed_only_with_the_same_reused_points(tmp_path):
    small, path = tmp_path / "small.nc", tmp_path / "r.nc"
    run_to_file(SMALL, small)
    calls = iter(range(3))

    def stop(progress):
        if next(calls, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted):
        run_to_file(LARGE, path, executor=Threads(1), report=stop, reuse=[small])
    with pytest.raises(InputError, match=r"takes points from small.nc; expected the same again, or --fresh"):
        run_to_file(LARGE, path)
    assert status(LARGE, path).done > 22
    assert run_to_file(LARGE, path, reuse=[small]).reused > 22


def test_lost_points_are_computed_again(tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(SMALL, path)
    with h5py.File(path, "r+") as file:
        file["outcome"][0, :3] = Outcome.LOST
        checksums.seal(file)
    with pytest.raises(InputError, match="another scene"):
        run_to_file(LARGE, path)
    assert run_to_file(LARGE, tmp_path / "new.nc", reuse=[path]).reused == 19


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"options": {"method": "other"}}, "method is other, was plain"),
        ({"options": {"rtol": 1e-6}}, "options.rtol is 1e-06, was 1e-10"),
        ({"outputs": [*NAMES, "effort_seen"]}, "lacks effort_seen"),
        ({"analysis": "slow"}, "analysis is slow, was toy"),
        ({"fixed": {"n": 4}}, "holds none of the points"),
    ],
)
def test_results_that_differ_in_more_than_points_are_refused(tmp_path, change, reason):
    run_to_file(SMALL, tmp_path / "small.nc")
    with pytest.raises(InputError, match=reason):
        run_to_file(LARGE | change, tmp_path / "r.nc", reuse=[tmp_path / "small.nc"])
    assert [p.name for p in tmp_path.iterdir()] == ["small.nc"]


def test_other_numerics_are_refused(tmp_path, monkeypatch):
    run_to_file(SMALL, tmp_path / "r.nc")
    from drivetrain_jax import _programs

    monkeypatch.setattr(_programs, "versions", lambda names: dict.fromkeys(names, "0"))
    with pytest.raises(InputError, match=r"another scene or version: axes.a is 161 .*; diffrax is 0, was"):
        run_to_file(LARGE, tmp_path / "r.nc")
    with pytest.raises(InputError, match="diffrax is 0, was"):
        run_to_file(LARGE, tmp_path / "new.nc", reuse=[tmp_path / "r.nc"])
    found = status(SMALL, tmp_path / "r.nc")
    assert found.state == "stale" and "diffrax is 0, was" in found.reason and "--fresh" in found.reason


def test_paths_without_a_result_are_refused(tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "zarr.json").touch()
    for name, what in (("nothing.nc", "does not exist"), (".", "is a folder"), ("store", "a Zarr store; use xarray")):
        with pytest.raises(InputError, match=what):
            run_to_file(SMALL, tmp_path / "r.nc", reuse=[tmp_path / name])
    assert not (tmp_path / "r.nc").exists()
    with pytest.raises(InputError, match="reuse: given without out"):
        dt.run(SMALL, reuse=["r.nc"])
    assert dt.run(SMALL, tmp_path / "small.nc").sizes["a"] == 11
    for name in ("small.nc", tmp_path / "small.nc"):
        larger = dt.run(
            LARGE, tmp_path / "large.nc", reuse=str(tmp_path / name) if name == "small.nc" else name, fresh=True
        )
        assert larger.attrs["reused_points"] == 22


def turned(path, **changes):
    """A copy written by xarray with fewer points or in another order."""
    opened(path).isel(**changes).to_netcdf(path.with_name("turned.nc"), engine="h5netcdf")
    return path.with_name("turned.nc")


@pytest.mark.parametrize(
    "change",
    full_after(2, [{"a": slice(None, None, -1)}, {"a": slice(0, 5)}, {"part": slice(None, None, -1)}, {"b": 0}]),
    ids=["mirrored", "cut", "mirrored results", "one value"],
)
def test_a_rearranged_copy_is_neither_reused_nor_complete(tmp_path, change):
    run_to_file(SMALL, tmp_path / "r.nc")
    copy = turned(tmp_path / "r.nc", **change)
    before = copy.read_bytes()
    with pytest.raises(InputError, match=r"reuse = '.*turned.nc': damaged \("):
        run_to_file(LARGE, tmp_path / "new.nc", reuse=[copy])
    with pytest.raises(InputError, match=r"holds a damaged result \(.*--fresh replaces it"):
        run_to_file(LARGE, copy)
    with pytest.raises(InputError, match=r"holds a damaged result \(.*--fresh replaces it"):
        run_to_file(SMALL, copy)
    assert status(SMALL, copy).state == "stale"
    assert copy.read_bytes() == before and not (tmp_path / "new.nc").exists()
    assert counts(run_to_file(SMALL, copy, fresh=True)) == (22, 22, 0)


def test_damaged_values_do_not_enter_another_result(tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(SMALL, path)
    with h5py.File(path, "r+") as file:
        file["value"][1, 3] = -7.0
    with pytest.raises(InputError, match=r"holds a damaged result \(value\); --fresh replaces it"):
        run_to_file(LARGE, path)
    with pytest.raises(InputError, match=r"r.nc': damaged \(value\); restore"):
        run_to_file(LARGE, tmp_path / "new.nc", reuse=[path])
    with h5py.File(path, "r+") as file:
        del file.attrs["checksums"]
    with pytest.raises(InputError, match=r"damaged \(it has no checksums\)"):
        run_to_file(LARGE, tmp_path / "new.nc", reuse=[path])


def test_damage_during_an_interrupted_growth_is_named(tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(SMALL, path)
    with pytest.raises(Interrupted):
        run_to_file(LARGE, path, executor=Threads(1), report=stop_after(2))
    with h5py.File(path, "r+") as file:
        file["value"][1, 3] = -7.0
    assert "damaged result (value)" in status(LARGE, path).reason
    with pytest.raises(InputError, match=r"damaged result \(value\); --fresh replaces it"):
        run_to_file(LARGE, path)


POINTS = {"system": "toy", "analysis": "toy", "outputs": NAMES, "points": {"a": [1.0, 8.0], "b": [1.0, 2.0]}}


@pytest.mark.parametrize(
    ("small", "large"),
    [
        (POINTS, POINTS | {"points": {"a": [1.0, 1.0], "b": [1.0, 1.0]}}),
        (
            scene({"a": [1.0, 2.0, 3.0], "b": [1.0, 2.0]}),
            scene({"a": [1.0, 2.0, 3.0], "unused": [0.0, 1.0]}, {"b": 1.0}),
        ),
        (scene({"a": [1.0, 2.0]}), scene({"a": [1.0, 2.0, 3.0]}, outputs=["value"])),
        (scene({"a": [1.0, 2.0]}), scene({"a": [1.0, 2.0]}, outputs=["value"])),
    ],
    ids=["one point twice", "one value under two labels", "fewer results", "fewer results of the same points"],
)
def test_points_of_the_former_result_alone_are_not_dropped(tmp_path, small, large):
    path = tmp_path / "r.nc"
    run_to_file(small, path)
    before = path.read_bytes()
    with pytest.raises(InputError, match="--fresh replaces it"):
        run_to_file(large, path)
    assert path.read_bytes() == before and status(large, path).state == "stale"
    assert run_to_file(large, tmp_path / "other.nc", reuse=[path]).reused > 1
    run_to_file(large, path, fresh=True)
    assert status(large, path).state == "complete"


def small_and_interrupted(path, **more):
    """Write a small result, and unfinished work that will replace it."""
    run_to_file(SMALL, path)
    with pytest.raises(Interrupted) as stopped:
        run_to_file(LARGE, path, executor=Threads(1), report=stop_after(2), **more)
    assert stopped.value.progress.computed > 0
    return stopped.value.progress.computed


@pytest.mark.parametrize("again", [True, False])
def test_an_interrupted_fresh_run_is_resumed_with_and_without_fresh(tmp_path, again):
    path = tmp_path / "r.nc"
    done = small_and_interrupted(path, fresh=True)
    assert (status(LARGE, path).state, status(LARGE, path).done) == ("partial", done)
    assert counts(run_to_file(LARGE, path, fresh=again)) == (322, 322 - done, done)
    # After the run has finished, fresh computes everything again.
    assert counts(run_to_file(LARGE, path, fresh=True)) == (322, 322, 0)


def test_fresh_drops_other_unfinished_work(tmp_path):
    path = tmp_path / "r.nc"
    small_and_interrupted(path)
    assert counts(run_to_file(LARGE, path, fresh=True)) == (322, 322, 0)
    run_to_file(SMALL, tmp_path / "s.nc")
    small_and_interrupted(tmp_path / "t.nc", fresh=True)
    # The unfinished work was started with other reused points.
    assert counts(run_to_file(LARGE, tmp_path / "t.nc", fresh=True, reuse=[tmp_path / "s.nc"])) == (322, 300, 22)


def test_reading_a_result_keeps_an_interrupted_fresh_run(tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(LARGE, path)
    with pytest.raises(Interrupted) as stopped:
        run_to_file(LARGE, path, fresh=True, executor=Threads(1), report=stop_after(2))
    assert counts(run_to_file(LARGE, path)) == (322, 0, 322)
    assert run_to_file(LARGE, path, fresh=True).reused == stopped.value.progress.computed > 0
