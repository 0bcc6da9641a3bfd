import gc
import os
from collections.abc import Iterator
from itertools import count

# One thread for each process of the tests, as several share the cores; tables as wide as without xdist.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.pop("COLUMNS", None)

import hypothesis
import pytest
import torch
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

CHECKED_STEPS = (
    2  # Control steps of a test with checks, which take longer than the step; shapes stay as they are.
)

# Shared machines are too uneven for a deadline per example; the same examples in every run.
hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True)
hypothesis.settings.load_profile("repeatable")


LONGEST = {"test_rehearsal.py", "test_deploy_process.py"}
"""Files whose tests mostly wait for processes: begun first, they wait beside the others' work."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest; skip what needs a CUDA device where there is none."""
    items.sort(key=lambda item: item.path.name not in LONGEST)
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


def pytest_collection_finish() -> None:
    """What was imported stays: a test that collects garbage need not look through it."""
    gc.freeze()


@pytest.fixture(autouse=True)
def check_shapes_in_the_first_steps(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Check shapes up to the first control steps of a test."""
    from pixel2catch.envs.catch_env import CatchEnv

    step, taken = CatchEnv.step, count(1)

    def counted(env: CatchEnv, actions: dict[str, torch.Tensor]) -> object:
        if next(taken) > CHECKED_STEPS:
            config.update("jaxtyping_disable", True)
        return step(env, actions)

    monkeypatch.setattr(CatchEnv, "step", counted)
    yield
    config.update("jaxtyping_disable", False)


@pytest.fixture
def opengl() -> None:
    """Skip what draws where no OpenGL back end works."""
    from pixel2catch.errors import DeviceUnavailableError
    from pixel2catch.rendering.renderer import find_gl_backend

    try:
        find_gl_backend()
    except DeviceUnavailableError as error:
        pytest.skip(str(error))
