"""The numbers of a report for programs."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from pixel2catch.identification.fit_problem import LATENCY_UNIT
from pixel2catch.identification.identifiability import half_widths, ratios
from pixel2catch.identification.identify import Identification, tracking_errors
from pixel2catch.identification.report_tables import open_questions
from pixel2catch.robot.joint_dynamics import PARAMETERS

Content = dict[str, Any]


def numbers(result: Identification, circumstances: Mapping[str, Any]) -> Content:
    """All numbers of the report, in SI units, by joint.

    Args:
        result: What was found.
        circumstances: When, how and with which versions this was done.
    """
    fit, joints = result.fit, result.fit.dynamics.joints
    groups = {"held_out": result.of(is_held_out=True), "fitted": result.of(is_held_out=False)}
    errors = {group: tracking_errors(motions) if motions else {} for group, motions in groups.items()}
    recordings = [
        {
            "name": motion.recording.name,
            "is_held_out": motion.source.is_held_out,
            "checks": [asdict(check) for check in motion.source.checks],
        }
        for motion in result.motions
    ]
    return {
        "robot": result.start.robot,
        "free": list(fit.free),
        "physics_dt": result.physics_dt,
        "tracking_error": {
            group: {name: _by_joint(joints, values) for name, values in found.items()}
            for group, found in errors.items()
        },
        "parameters": {joint: _parameters(result, j) for j, joint in enumerate(joints)},
        "ratios": {
            ratio.name: {
                joint: _interval(ratio.value[j], ratio.half_width[j]) for j, joint in enumerate(joints)
            }
            for ratio in ratios(fit)
        },
        "not_identified": open_questions(fit),
        "recordings": recordings,
        "circumstances": dict(circumstances),
    }


def _by_joint(joints: Sequence[str], values: np.ndarray) -> dict[str, float]:
    return dict(zip(joints, values.tolist(), strict=True))


def _parameters(result: Identification, j: int) -> Content:
    """Value before and after of every parameter of a joint, and its 95 % interval if it was fitted."""
    fit = result.fit
    widths = dict(zip(fit.free, half_widths(fit)[j], strict=True))
    found: Content = {}
    for name in PARAMETERS:
        value, before = float(getattr(fit.dynamics, name)[j]), float(getattr(result.start.before, name)[j])
        content: Content = {"value": value}
        if name == "latency" and name in widths:
            width = LATENCY_UNIT * widths[name]
            content["interval"] = [max(0.0, value - width), value + width]
        elif name in widths:
            content = _interval(value, widths[name])
        finite = {key: each if np.all(np.isfinite(each)) else None for key, each in content.items()}
        found[name] = finite | {"before": before if np.isfinite(before) else None}
    return found


def _interval(value: float, half_width: float) -> Content:
    """A value whose logarithm has an interval."""
    factor = float(np.exp(half_width))
    return {"value": float(value), "interval": [float(value) / factor, float(value) * factor]}
