"""Budgets of a test run: CPU time of each test and of all, memory of each process, and one cache of compiled code.

A newcomer's computer has two slow cores and 8 GB, and `make test` runs two processes.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import shutil
import statistics
import sys
import time
from pathlib import Path

import pytest

# Limits in reference seconds: of one test that is not marked `full`, and of a whole run of `make test` and `make validate`.
# The unit is measured all along: computations take up to twice the CPU time while another one runs beside them. One test
# still measured 3.4 and 5.9, so a test fails beyond its limit times the noise.
LONGEST, NOISE, TOTAL = 5.0, 1.6, {"not full and not docs": 1200.0, "full": 9000.0}
# CPU seconds of `reference` on the machine that the limits refer to: there the tests of d7ff433 took 2,300 s.
REFERENCE = 0.081
# Seconds between two measurements of it.
BETWEEN = 15.0
# Growth that a compilation leaves behind, and resident memory above which compiled code is dropped, in bytes.
GROWTH, LIMIT = 200 << 20, 1280 << 20
# Size of the cache of compiled code at which it begins anew, in bytes.
CACHE = 1 << 30
# Compiler flags: neither optimisation nor passes that take a sixth of the compilation and make code that runs once faster.
LEFT_OUT = (
    "while-loop-invariant-code-motion,while-loop-constant-sinking,simplify-while-loops,"
    "post_scatter_expansion_simplification,tree_reduction_rewriter,reshape-mover"
)
XLA_FLAGS = (
    f"--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_disable_hlo_passes={LEFT_OUT}"
)
_after_trim = 0


def pytest_configure(config):
    """`make test` compiles without optimisation, in half of the time; `make validate` compiles as users do."""
    if config.getoption("markexpr") != "full":
        os.environ.setdefault("XLA_FLAGS", XLA_FLAGS)
    if config.pluginmanager.hasplugin("cacheprovider"):
        compiled = Path(config.cache.mkdir("compiled"))
        if not hasattr(config, "workerinput") and sum(f.stat().st_size for f in compiled.iterdir()) > CACHE:
            shutil.rmtree(compiled)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(compiled))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
    # Two processes use both cores: a second thread of BLAS only waits for the first one, and spins meanwhile.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Nobody reads where the operations of a test come from: 2.5 % of tracing and compiling.
    os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
    # Traces leave many objects and hardly any garbage.
    gc.set_threshold(50_000, 20, 50)
    config.pluginmanager.register(Budget(config))


def reference() -> float:
    """CPU seconds of a computation of about a twentieth of a second in plain Python."""
    begin, table = time.process_time(), {}
    for i in range(200_000):
        table[str(i % 997)] = (i * 7919) % 10007
    sorted(range(100_000), key=lambda i: (i * 7919) % 10007)
    return time.process_time() - begin


def cpu(who: int) -> float:
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


class Budget:
    """Counts the CPU time of tests in reference seconds, and fails what exceeds its limit.

    A test is not charged for compilation, because that meets the test that happens to come first.
    """

    def __init__(self, config: pytest.Config):
        self.total, self.limit = 0.0, TOTAL.get(config.getoption("markexpr"))
        # CPU seconds of this process in a reference second, and the time of the last measurement.
        self.units: list[float] = []
        self.last = -BETWEEN
        self.spans: list[tuple[float, float]] = []

    def measure(self) -> None:
        """Measure the unit again if the last time was long ago."""
        if time.monotonic() > self.last + BETWEEN:
            self.units.append(reference() / REFERENCE)
            self.last = time.monotonic()

    def heard(self, event: str, seconds: float, **_: object) -> None:
        """Note the wall time of a trace or compilation, which includes those within it."""
        if event.startswith("/jax/core/compile/"):
            end = time.monotonic()
            while self.spans and self.spans[-1][0] >= end - seconds:
                self.spans.pop()
            self.spans.append((end - seconds, end))

    def measured(self, item: pytest.Item):
        if (jax := sys.modules.get("jax")) and not self.spans:
            jax.monitoring.register_event_duration_secs_listener(self.heard)
            self.spans.append((0.0, 0.0))
        self.measure()
        begin, own, children = time.monotonic(), cpu(resource.RUSAGE_SELF), cpu(resource.RUSAGE_CHILDREN)
        result = yield
        wall = max(time.monotonic() - begin, 1e-9)
        compiling = sum(end - start for start, end in self.spans if start >= begin)
        seconds = (cpu(resource.RUSAGE_SELF) - own) * max(1 - compiling / wall, 0)
        self.measure()
        seconds = (seconds + cpu(resource.RUSAGE_CHILDREN) - children) / statistics.median(self.units[-5:])
        if seconds > NOISE * LONGEST and not any(item.get_closest_marker(name) for name in ("full", "docs")):
            pytest.fail(
                f"{seconds:.1f} reference seconds, expected at most {NOISE * LONGEST}: shorten or mark full",
                pytrace=False,
            )
        return result

    pytest_runtest_setup = pytest.hookimpl(wrapper=True)(measured)
    pytest_runtest_call = pytest.hookimpl(wrapper=True)(measured)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.total += getattr(node, "workeroutput", {}).get("reference_seconds", 0.0)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session):
        self.measure()
        # Workers count themselves; to the process that starts them they are children.
        alone = not session.config.getoption("numprocesses", None)
        self.total += (cpu(resource.RUSAGE_SELF) + alone * cpu(resource.RUSAGE_CHILDREN)) / statistics.mean(self.units)
        if hasattr(session.config, "workerinput"):
            session.config.workeroutput["reference_seconds"] = self.total
        elif self.limit and self.total > self.limit:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        allowed = f", expected at most {self.limit:.0f}" if self.limit else ""
        terminalreporter.write_line(f"{self.total:.0f} reference seconds of CPU time{allowed}")


def resident() -> int:
    """Resident memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def trim() -> None:
    """Return free memory to the system: the allocator keeps what the compiler used, 700 MB after a large kernel."""
    global _after_trim
    ctypes.CDLL(None).malloc_trim(0)
    _after_trim = resident()


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_runtest_teardown(item, nextitem):
    try:
        return (yield)
    finally:
        if resident() > _after_trim + GROWTH:
            trim()
        last = nextitem is None or nextitem.path != item.path
        if last and resident() > LIMIT and (jax := sys.modules.get("jax")):
            jax.clear_caches()
            gc.collect()
            trim()


@pytest.fixture
def retraced():
    """Traces anew, in this test and after it, what depends on a constant that the test changes."""
    from drivetrain_jax.analysis.numerics import lanes

    lanes._trace.cache_clear()
    yield
    lanes._trace.cache_clear()
