"""The accessor ``.drivetrain`` of Datasets, and results as tables of text."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from drivetrain_jax._errors import InputError

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from drivetrain_jax.explore import Page
    from drivetrain_jax.invariants import Report
    from drivetrain_jax.runs.atlas_file import StoredAtlas
    from drivetrain_jax.runs.reply import Reply

# Rows that are text in memory at a time.
_ROWS = 100_000
# Longest dimension of an analysis whose entries are columns; those of a longer one, such as time, are rows.
_MOST_COLUMNS = 32


class DrivetrainAccessor:
    """Methods of a result of this package: ``dataset.drivetrain``."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    def plot(self, *others: xr.Dataset | str | Path, **options: Any) -> Figure:
        """The figure of the result; arguments as of :func:`drivetrain_jax.plot`."""
        from drivetrain_jax.datasets.figure import plot

        return plot(self._dataset, *others, **options)

    def table(self) -> pd.DataFrame:
        """The result as a table of pandas, a row for each point, or each sample of a point (time, position along a shaft).

        Columns are swept parameters, physical data along them, and results; entries of a short dimension have columns of
        their own (``critical_speed_1``), where ``to_dataframe`` has rows. Units are in the header, ``Omega [rad/s]``; codes
        are words.
        """
        # Local import: it takes a third of a second.
        import pandas as pd

        if "outcome" not in self._dataset:
            raise InputError("outcome: missing; expected a result on a grid")
        columns: dict[str, np.ndarray] = {}
        for name, values in _columns(self._dataset):
            if name in columns:
                raise InputError(f"table: {name!r} names two columns; expected results of other names (rename one)")
            columns[name] = np.ravel(values)
        return pd.DataFrame(columns)

    def verify(self) -> Report:
        """The report on the rules of the analysis and on the checksums of the file.

        Returns: a report to be printed; ``problem`` is the first problem, empty without one.
        """
        from drivetrain_jax.datasets.figure import lacks
        from drivetrain_jax.invariants import verify_dataset

        self._analysis()
        if "outcome" in self._dataset and self._dataset["outcome"].dtype.kind not in "iu":
            raise InputError("outcome: no codes; expected the result itself, as before .named() or a mean")
        try:
            return verify_dataset(self._dataset, self._file())
        except InputError:
            raise
        except (KeyError, ValueError) as error:
            raise lacks(error, "a rule needs") from error

    def query(self, **values: Any) -> Reply:
        """The answer of an atlas at one point: results, gradient, and the nearest changes of stability.

        Args:
            values: every parameter of the atlas, in its units or in physical ones.

        Returns: an answer to be printed; ``data`` holds it in plain numbers.

        Raises: InputError for a result on a grid, and for values outside the atlas.
        """
        from drivetrain_jax.runs.atlas_answers import query

        return query(self._atlas("query"), values)

    def explore(self) -> Page:
        """The explorer of an atlas: an HTML page that evaluates it in the browser, which a notebook shows.

        Returns: the page; ``text`` is its HTML, one file that loads nothing.

        Raises: InputError for a result on a grid.
        """
        return self._atlas("explore").explore()

    def resonances(self) -> xr.DataArray:
        """The resonances that the system predicts along an axis of the result, such as ``resonance_Omega``, with labels.

        Raises: InputError if the system predicts none along the axes of this result.
        """
        from drivetrain_jax.runs.predicted import resonances

        self._analysis()
        predicted = resonances(self._dataset)
        if predicted is None:
            raise InputError("resonances: none are predicted along these axes; expected a chart that has some")
        return predicted

    def orders(self) -> xr.DataArray:
        """The speeds [rpm] at which orders of the excitation meet the natural frequencies, with a dimension ``order``.

        Orders are those of the mesh and of the planets (``planetary`` with ``teeth``), or of unbalance and joints.

        >>> import drivetrain_jax as dt
        >>> gear = {"system": "planetary", "analysis": "modes", "fixed": {"teeth": [20, 26, 72]}}
        >>> print(dt.run(gear).drivetrain.orders().sel(order="mesh order 1", mode=2).round(1).item())
        606.1

        Raises: InputError for a result without frequencies, or of a system whose orders are not known.
        """
        from drivetrain_jax.resonances import FREQUENCIES, in_hertz, stored_orders

        self._analysis()
        orders = stored_orders(self._dataset.attrs)
        name = next((name for name in FREQUENCIES if name in self._dataset), None)
        if orders is None or name is None:
            raise InputError(
                "orders: not known; expected a result with frequencies, of a planetary gear with its teeth"
            )
        frequency = self._dataset[name]
        order = xr.DataArray(list(orders.per_turn), dims="order", name="order", attrs={"long_name": "order"})
        attrs = {"units": "rpm", "long_name": f"speed of the {orders.shaft} at which the order meets the mode"}
        dims = (*frequency.dims, "order")
        return xr.DataArray(
            orders.speeds(in_hertz(frequency.values, frequency.attrs["units"])),
            {**frequency.coords, "order": order},
            dims,
            "order_speed",
            attrs,
        )

    def named(self) -> xr.Dataset:
        """The result with words for codes, and with the values that do not vary, defaults included, as coordinates.

        Entries of a list become coordinates of their own: ``length_0``, ``length_1``. Nothing is loaded.

        >>> import drivetrain_jax as dt
        >>> shaft = dt.Cardan(beta=0.3, Omega=1.4, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
        >>> chart = dt.sweep(dt.floquet, shaft, over={"Omega": [1.2, 1.415]}).drivetrain.named()
        >>> chart.verdict.values.tolist(), float(chart.zeta)
        (['stable', 'unstable'], 0.001)
        """
        self._analysis()
        dataset = self._dataset
        coded = {name: v for name, v in dataset.variables.items() if "flag_meanings" in v.attrs}
        named = dataset.assign({name: in_words(variable) for name, variable in coded.items()})
        fixed = json.loads(dataset.attrs.get("fixed_parameters", "{}"))
        return named.assign_coords(
            {
                name: ((), value, attrs)
                for parameter, entry in fixed.items()
                for name, value, attrs in _scalars(parameter, entry)
                if not {name, attrs["parameter"]} & {str(known) for known in dataset.variables}
            }
        )

    def _analysis(self) -> str:
        analysis = self._dataset.attrs.get("analysis")
        if analysis is None:
            raise InputError("dataset: has no attribute 'analysis'; expected a result of drivetrain_jax")
        return analysis

    def _atlas(self, method: str) -> StoredAtlas:
        """The atlas that this dataset holds or is drawn from; ``method`` asks for it."""
        from drivetrain_jax.runs.atlas_file import open_atlas

        if self._analysis() == "atlas":
            return open_atlas(self._dataset)
        file = self._file()
        if file is None or self._dataset.attrs.get("method") != "atlas":
            raise InputError(f"{method}: the result holds values on a grid; expected an atlas, opened from its file")
        return open_atlas(file)

    def _file(self) -> Path | None:
        """The file that the dataset was opened from, if it is still there."""
        source = self._dataset.encoding.get("source")
        return Path(source) if isinstance(source, str) and Path(source).is_file() else None


def _scalars(name: str, entry: dict[str, Any]) -> list[tuple[str, Any, dict[str, str]]]:
    value, labels = entry["value"], {key: entry[key] for key in ("units", "long_name") if key in entry}
    if not isinstance(value, list):
        # JSON has no infinity.
        return [(name, np.inf if value == "inf" else value, labels | {"parameter": name})]
    return [(f"{name}_{i}", number, labels | {"parameter": f"{name}[{i}]"}) for i, number in enumerate(value)]


def in_words(variable: xr.Variable) -> xr.Variable:
    """A variable of codes as words, looked up lazily; a code without a meaning becomes an empty word."""
    words = _Words(variable)
    attrs = {name: value for name, value in variable.attrs.items() if not name.startswith("flag_")}
    encoding = {name: sizes for name, sizes in variable.encoding.items() if name == "preferred_chunks"}
    if variable.chunks is None:
        return xr.Variable(variable.dims, indexing.LazilyIndexedArray(words), attrs, encoding)
    blocks = variable.data.map_blocks(words.meanings, dtype=words.dtype)  # pyright: ignore[reportAttributeAccessIssue]
    return xr.Variable(variable.dims, blocks, attrs, encoding)


class _Words(BackendArray):
    """Meanings of the codes of a variable."""

    def __init__(self, codes: xr.Variable) -> None:
        self._codes, self.shape = codes, codes.shape
        meanings = codes.attrs["flag_meanings"].split()
        self._meanings = dict(zip(np.atleast_1d(codes.attrs["flag_values"]).tolist(), meanings, strict=True))
        self.dtype = np.array(meanings).dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> np.ndarray:
        support = indexing.IndexingSupport.OUTER
        return indexing.explicit_indexing_adapter(
            key, self.shape, support, lambda part: self.meanings(self._codes[part].values)
        )

    def meanings(self, codes: np.ndarray) -> np.ndarray:
        """The words for these codes."""
        words = np.full(np.shape(codes), "", self.dtype)
        for code, meaning in self._meanings.items():
            words[codes == code] = meaning
        return words


def write_csv(source: Path, out: Path) -> int:
    """Write the result ``source`` as the table ``out``, see :meth:`DrivetrainAccessor.table`; returns its number of rows."""
    from drivetrain_jax.runs.output import open_result
    from drivetrain_jax.store.files import behind_link, move_into_place, naming

    dataset = open_result(source)
    if dataset.attrs.get("analysis") == "atlas" or "outcome" not in dataset:
        raise InputError(f"file = {str(source)!r}: holds no values on a grid; expected a chart of it, saved as a file")
    out, table = behind_link(out), dataset.drivetrain.table()
    temporary = out.with_name(f"{out.name}.tmp")
    try:
        with naming(temporary):
            table.to_csv(temporary, index=False, chunksize=_ROWS)
        move_into_place(temporary, out)
    finally:
        temporary.unlink(missing_ok=True)
    return len(table)


def _columns(dataset: xr.Dataset) -> Iterator[tuple[str, np.ndarray]]:
    """Header and values, with the shape of all rows, of every column."""
    # Local import: the style may import xarray first, whose import registers the accessor.
    from drivetrain_jax.view.style import scene_key

    sweep = dataset["outcome"].dims
    sweep = (*sweep, *(dim for dim, size in dataset.sizes.items() if dim not in sweep and size > _MOST_COLUMNS))
    along = [c for c in dataset.coords.values() if c.ndim and set(c.dims) <= set(sweep)]
    for variable in (*along, *dataset.data_vars.values()):
        words = in_words(variable.variable) if "flag_meanings" in variable.attrs else variable.variable
        inner = [dim for dim in words.dims if dim not in sweep]
        values = words.set_dims({dim: dataset.sizes[dim] for dim in (*sweep, *inner)}).transpose(*sweep, *inner).values
        name = scene_key(variable) if variable.name in dataset.coords else str(variable.name)
        units = f" [{u}]" if (u := str(variable.attrs.get("units", "1"))) not in ("1", "") else ""
        for entry in np.ndindex(values.shape[len(sweep) :]):
            labels = [
                str(dataset[dim].values[k]) if dim in dataset.coords else str(k + 1)
                for dim, k in zip(inner, entry, strict=True)
            ]
            column, header = values[(..., *entry)], "_".join((name, *labels))
            if column.dtype.kind == "c":
                yield f"{header}_real{units}", np.real(column)
                yield f"{header}_imag{units}", np.imag(column)
            else:
                yield header + units, column
