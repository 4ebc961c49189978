import gc
import os
import signal
from importlib.metadata import version
from pathlib import Path

# Before JAX is imported, and for the processes that tests start: two thirds of the suite's time were XLA at work on
# programs that run once. At this level XLA and what it compiles take least together. `make slow` compiles as users do.
if "xla_backend_optimization_level" not in os.environ.get("XLA_FLAGS", ""):
    flags = [os.environ.get("XLA_FLAGS", ""), "--xla_backend_optimization_level=0"]
    flags.append("--xla_llvm_disable_expensive_passes=true")
    # The verbs of jaxeit are compiled without fusion emitters, and so in half the time is what the tests compile
    # themselves; a program in one piece, as each worker has a core. XLA ends the process for a flag that it does not
    # know, and jaxlib 0.11 knows the first of these no more.
    if version("jaxlib").startswith("0.10."):
        flags += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
    os.environ["XLA_FLAGS"] = " ".join(flags).strip()
# Nobody reads where in Python each operation of a program comes from: 100 frames of every one, unless told otherwise.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
# There is a worker a core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# A mask times a number, or a count times a length, is an error, here and in the processes that tests start.
os.environ.setdefault("JAX_NUMPY_DTYPE_PROMOTION", "strict")

import tests.annotations

# Before the packages are imported. `make slow` leaves the check out.
tests.annotations.install()

import jax
import pytest

import calib.runtime
import jaxeit as je
import tests.mlir_contexts

from .helpers import bound_maps
from .scheduling import RoomScheduling

pytest_plugins = ["tests.hard_cases"]

# What a shell runs in the background ignores this, and so would the processes that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

tests.mlir_contexts.install()

# Commands that run in the tests' own process trace their programs, so that annotations are checked.
calib.runtime.keep_programs = lambda folder: None

# What is imported stays: looking through it for garbage, again and again, is a twentieth of the time of the suite.
gc.freeze()
gc.set_threshold(100_000, 50, 100)

jax.config.update("jax_enable_x64", True)
# Tests call parts of verbs by themselves. That whole verbs ask for this precision is tested in hard/.
if jax.devices()[0].platform != "cpu":
    jax.config.update("jax_default_matmul_precision", "highest")
# Programs compiled once serve all later tests, and the next run.
jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


@pytest.hookimpl(optionalhook=True)  # without pytest-xdist, -p no:xdist, nobody asks
def pytest_xdist_make_scheduler(config, log):
    return RoomScheduling(config, log)


def pytest_runtest_setup():
    tests.annotations.begin_test()


@pytest.fixture(autouse=True, scope="module")
def _bounded_maps():
    yield
    bound_maps()


@pytest.fixture(scope="session")
def skin():
    return je.load_skin("testbed")


@pytest.fixture(scope="session")
def model(skin):
    """The ideal testbed at draft fidelity, float64."""
    return je.discretise(je.Scene(skin), je.Fidelity.draft())


@pytest.fixture(scope="session")
def pixels(model):
    return je.Pixels(20).on(model)


@pytest.fixture(scope="session")
def root():
    return Path(__file__).parents[1]


@pytest.fixture(scope="session")
def bundled(root):
    return sorted((root / "data" / "sessions").glob("*.h5"))


@pytest.fixture
def compilations():
    """What JAX traces, lowers or compiles during a test."""
    seen = []

    def note(event, *_, **__):
        if "/compile/" in event:
            seen.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    yield seen
    jax.monitoring.unregister_event_duration_listener(note)
