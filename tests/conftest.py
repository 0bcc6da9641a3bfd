import gc
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from functools import wraps
from multiprocessing import get_context
from pkgutil import resolve_name
from typing import Any

# One thread for each process of the tests, as several share the cores; tables as wide as without xdist.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.pop("COLUMNS", None)

import hypothesis
import pytest
from jaxtyping import config, install_import_hook

# Where tensors are handed over, shapes and types are checked at run time; the tower lets an int stand for a
# float, as PEP 484 does. Not in what ticks 500 times a second: there the checks take longer than the work.
ROOMS = (
    "agents api camera envs evaluation identification mdp methods perception policy rendering robots scene "
    "sim"
)
install_import_hook(
    [f"pixel2catch.{room}" for room in ROOMS.split()],
    "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))",
)

CHECKED_CALLS = {
    "pixel2catch.envs.catch_env.CatchEnv.step": 2,
    "pixel2catch.deployment.policy_pipeline.PolicyPipeline.decide": 2,
    "pixel2catch.twin.simulated_lab.SimulatedLab.step": 20,
}
"""How many calls of a test are checked: a check takes longer than the call, and shapes stay as they are."""

CALLS: Counter[Callable[..., Any]] = Counter()  #: Those of the present test.

# Shared machines are too uneven for limits on the wall-clock time of examples and of their draws: a draw may
# also read the sources of all imported modules. The same examples in every run.
hypothesis.settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("repeatable")


LONGEST = ("rehearsal", "frozen", "distributed", "documents", "protocol", "analytic", "stepped")
"""Files that take longest, in this order: begun first, none is left to one worker at the end.

The first alone of the first three needs the compiled servo: the others do not wait for its compilation.
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest; skip what needs a CUDA device where there is none."""
    import torch  # not at the top: the process that leads the workers does not need it

    items.sort(key=lambda item: [item.path.stem != f"test_{name}" for name in LONGEST])
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


def pytest_collection_finish() -> None:
    """Count the calls; what was imported stays: a test that collects garbage need not look through it."""
    for name, most in CHECKED_CALLS.items():
        owner, _, function = name.rpartition(".")
        setattr(resolve_name(owner), function, counted(resolve_name(name), most))
    gc.freeze()


def counted(function: Callable[..., Any], most: int) -> Callable[..., Any]:
    """The function, whose later calls in a test end the checks of shapes."""

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        CALLS[function] += 1
        if CALLS[function] > most:
            config.update("jaxtyping_disable", True)
        return function(*args, **kwargs)

    return call


def pytest_runtest_setup() -> None:
    config.update("jaxtyping_disable", False)
    CALLS.clear()


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that is refused, and returns its error."""

    def run(*args: object) -> str:
        from pixel2catch.cli.main import main

        assert main([*map(str, args)]) == 2
        return capsys.readouterr().err

    return run


def change_cells() -> Iterator[None]:
    """Throws of evaluations last 20 control steps; cells of studies are computed in forks of this process.

    Forks import nothing; CUDA forbids them. `test_grid` and `test_own_methods` spawn processes as users do.
    """
    import torch

    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.evaluation import grid

    def begin_fork(begin: Callable[[], None] = grid._begin) -> None:
        sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__  # not what pytest captures here
        begin()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CatchEnvCfg, "trial_steps", 20)
        if not torch.cuda.is_available():
            patch.setattr(grid, "get_context", lambda _: get_context("fork"))
            patch.setattr(grid, "_begin", begin_fork)
        yield


small_cells = pytest.fixture(change_cells)
small_study = pytest.fixture(change_cells, scope="module")


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip what draws where no OpenGL back end works."""
    from pixel2catch.errors import DeviceUnavailableError
    from pixel2catch.rendering.renderer import find_gl_backend

    try:
        find_gl_backend()
    except DeviceUnavailableError as error:
        pytest.skip(str(error))
