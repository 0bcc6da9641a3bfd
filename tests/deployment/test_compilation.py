"""The compiled tick: equal to Python, compiled once, never from old sources."""

import importlib
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from chaos import Chaos
from servo_rows import LIMITS, Lab

from pixel2catch.servo import laws, tick
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import Mode
from pixel2catch.servo.tick import Limits, ServoCore, ServoState, tick_all
from pixel2catch.workcells import find_workcell


def interpreted(limits: Limits, *arrays: np.ndarray) -> None:
    own_limits = Limits(limits.robot.view(np.recarray), limits.joints.view(np.recarray), limits.space)
    with np.errstate(all="ignore"):
        tick_all.python(
            own_limits, *(array.view(np.recarray) if array.dtype.names else array for array in arrays)
        )


def test_the_compiled_tick_does_what_its_python_does(monkeypatch: pytest.MonkeyPatch):
    """To the last bit, NaN included; every tenth tick, as Python takes 8 ms a row."""
    core = ServoCore(LIMITS)
    chaos, state, modes = Chaos(8, LIMITS, seed=3), ServoState.idle(8, LIMITS), set[int]()
    for number in range(150):
        inputs, before = chaos.inputs(), state
        state = core.tick(before, inputs)
        chaos.follow(state["sent"])
        if number % 10 == 9:
            with monkeypatch.context() as patched:
                patched.setattr(tick, "tick_all", interpreted)
                same = core.tick(before, inputs)
            for name in ("robots", "joints"):
                for field in getattr(state, name).dtype.names:
                    np.testing.assert_array_equal(state[field], same[field], field)
            modes |= {*state["mode"].tolist()}
    assert modes >= {Mode.IDLE, Mode.RAMP, Mode.STOPPED}


def test_no_tick_compiles_anything():
    """For all robots, and for limits from another process."""
    for name in ("ur5e_allegro", "fr3_allegro", "two_ur5e_allegro"):
        ServoCore(ServoLimits.of(find_workcell(name)))
    Lab(limits=pickle.loads(pickle.dumps(LIMITS))).swung()
    assert tick_all.dispatcher is not None
    assert len(tick_all.dispatcher.signatures) == 1
    with pytest.raises(TypeError, match="No matching definition"):
        tick_all(*[1.0] * 6)


LAW = """from callee import factor
from pixel2catch.servo.laws import entry

@entry
def law(value): return factor() * value
"""


def write_law(folder: Path, factor: float) -> None:
    (folder / "callee.py").write_text(f"def factor(): return {factor}\n")
    (folder / "law.py").write_text(LAW)


def load_law(folder: Path, monkeypatch: pytest.MonkeyPatch) -> laws.entry:
    """Import the law as a fresh process does."""
    monkeypatch.syspath_prepend(str(folder))
    for name in ("callee", "law"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("law").law


def kept(folder: Path) -> list[Path]:
    return sorted(folder.glob("__pycache__/servo-*/*/*.nbi"))


def test_a_changed_callee_gives_a_new_result_in_a_fresh_process(tmp_path: Path, monkeypatch):
    """Code from older sources is not loaded; code from the same sources is. A damaged file is replaced."""
    write_law(tmp_path, 2.0)
    for is_kept in (False, True):
        law = load_law(tmp_path, monkeypatch)
        assert law(1.5) == 3.0
        assert bool(law.dispatcher.stats.cache_hits) == is_kept
    write_law(tmp_path, 40.0)  # another length: Python compares length and time of a source with its bytecode
    script = "from law import law; print(law(1.5))"
    run = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert run.stdout.strip() == "60.0", run.stderr
    for file in kept(tmp_path):
        file.write_bytes(b"no pickle")
    assert load_law(tmp_path, monkeypatch)(1.5) == 60.0


def test_without_a_writable_folder_it_is_compiled_in_each_process(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(laws.os, "access", lambda *_: False)
    write_law(tmp_path, 2.0)
    assert load_law(tmp_path, monkeypatch)(1.5) == 3.0
    assert not kept(tmp_path)
