"""The compiled tick: what its Python does, and compiled or loaded before the first one."""

import pickle
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaos import Chaos
from numba.core.caching import CompileResultCacheImpl, IndexDataCacheFile
from servo_rows import LIMITS, Lab

from pixel2catch.servo import compilation
from pixel2catch.servo.core import ServoCore, ServoState
from pixel2catch.servo.flags import Mode
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.tick import Limits, tick_all
from pixel2catch.workcells import find_workcell


def interpreted(limits: Limits, *arrays: np.ndarray) -> None:
    """What `tick_all` is compiled from, entries as Python has them."""
    kept_to = Limits(limits.robot.view(np.recarray), limits.joints.view(np.recarray), limits.space)
    with np.errstate(all="ignore"):
        tick_all.py_func(
            kept_to, *(array.view(np.recarray) if array.dtype.names else array for array in arrays)
        )


def test_the_compiled_tick_does_what_its_python_does(monkeypatch: pytest.MonkeyPatch):
    """To the last bit, NaN included, whatever it is told; every tenth tick: Python takes 8 ms a row."""
    compiled, python = ServoCore(LIMITS), ServoCore(LIMITS)
    monkeypatch.setattr(python, "_tick_all", interpreted)
    chaos, state, modes = Chaos(8, LIMITS, seed=3), ServoState.idle(8, LIMITS), set[int]()
    for number in range(150):
        inputs, before = chaos.inputs(), state
        state, output = compiled.tick(before, inputs)
        chaos.follow(output.command)
        if number % 10 == 9:
            same_state, same = python.tick(before, inputs)
            for name, value in vars(output).items():
                np.testing.assert_array_equal(value, getattr(same, name), name)
            for name in state.joints.dtype.names or ():
                np.testing.assert_array_equal(state.joints[name], same_state.joints[name], name)
            modes |= {*output.mode.tolist()}
    assert modes >= {Mode.IDLE, Mode.RAMP, Mode.STOPPED}


def test_no_tick_compiles_anything():
    """Nor does any robot with its limits, in this process or in one that gets them from here."""
    for name in ("ur5e_allegro", "fr3_allegro", "two_ur5e_allegro"):
        ServoCore(ServoLimits.of(find_workcell(name)))
    Lab(limits=pickle.loads(pickle.dumps(LIMITS))).swung()
    assert len(tick_all.signatures) == 1
    with pytest.raises(TypeError, match="No matching definition"):
        tick_all(*[1.0] * 7)


def compile_anew(folder: Path, factor: float = 2.0) -> Any:
    """Compile a law in a folder as another process would, or take what was kept."""
    (folder / "law.py").write_text(f"def scaled(value):\n    return {factor} * value\n")
    function = compilation.entry(runpy.run_path(str(folder / "law.py"))["scaled"])
    assert function(1.5) == factor * 1.5
    return function


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where sources are."""
    monkeypatch.setattr(compilation, "__file__", str(tmp_path / "compilation.py"))
    return tmp_path


def test_what_is_compiled_is_kept_until_any_source_changes(folder: Path):
    assert compile_anew(folder).stats.cache_misses
    assert compile_anew(folder).stats.cache_hits
    (folder / "limits.py").write_text("STOP_TIME = 0.3\n")
    assert compile_anew(folder).stats.cache_misses
    assert compile_anew(folder).stats.cache_hits
    assert len([*folder.glob("__pycache__/*.nb*")]) == 2


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("content", [b"", b"no pickle"])
def test_what_is_kept_and_cannot_be_read_is_compiled_again(folder: Path, suffix: str, content: bytes):
    compile_anew(folder)
    (kept,) = folder.glob(f"__pycache__/*.{suffix}")
    kept.write_bytes(content)
    assert not compile_anew(folder).stats.cache_hits


def test_what_was_kept_in_part_is_not_completed_by_what_was_before(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    """The disk is full, or the process ends, between the two files of it."""
    compile_anew(folder)
    monkeypatch.setattr(compilation._Cache, "_forget", lambda _: None)
    with monkeypatch.context() as patched:
        patched.setattr(IndexDataCacheFile, "_save_data", full)
        compile_anew(folder, factor=3.0)
    compile_anew(folder, factor=3.0)


def test_where_nothing_can_be_kept_it_is_compiled_all_the_same(folder: Path, monkeypatch: pytest.MonkeyPatch):
    """On a full disk, and where no folder is writable."""
    monkeypatch.setattr(IndexDataCacheFile, "save", full)
    assert compile_anew(folder).stats.cache_misses
    monkeypatch.setattr(CompileResultCacheImpl, "_locator_classes", [])
    compile_anew(folder)
    assert not [*folder.glob("__pycache__/*.nb*")]
