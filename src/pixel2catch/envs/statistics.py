"""Sums over ended episodes, by object, on the device."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from pixel2catch.batches import ByAgent, Flags
from pixel2catch.envs.episode import FAILURES, EpisodeRecord, failure

RATES = ("success", "palm_contact", "table_contact", "self_contact", "robot_contact")
"""Names of rates, besides `tracking_rate`."""

SHARES = ("is_tracked", "is_hand_contact", "is_dropped", *(f"is_{name}" for name in RATES))
SUMS = ("steps", "contact_steps", "penetration_sum")
SUCCESS_SUMS = ("hold_speed", "hold_palms")  #: Sums over successes.

MAXIMA = ("max_penetration", "max_joint_speed", "max_torque_share", "max_object_force")


class EpisodeStatistics:
    """Sums over ended episodes, and over the reward terms of every step, since the last `pop`."""

    def __init__(
        self, object_names: tuple[str, ...], reward_names: Mapping[str, tuple[str, ...]], device: torch.device
    ) -> None:
        """Start empty, for objects by row of the object table and the reward terms of each agent."""
        self._object_names, self._reward_names = object_names, reward_names
        self._modes = torch.arange(len(FAILURES), device=device)
        num_columns = 1 + len(SHARES) + len(SUMS) + len(SUCCESS_SUMS) + len(FAILURES)
        self._by_object = torch.zeros(len(object_names), num_columns, device=device)
        self._maxima = torch.zeros(len(MAXIMA), device=device)
        self._rewards = torch.zeros(2 + sum(map(len, reward_names.values())), device=device)

    def add(self, ended: Flags, record: EpisodeRecord, reward_terms: ByAgent, is_diverged: Flags) -> None:
        """Add the reward terms of a control step, the records of episodes that it ended, and divergences."""
        columns = [getattr(record, name).float() for name in (*SHARES, *SUMS)]
        columns += [torch.where(record.is_success, getattr(record, name), 0.0) for name in SUCCESS_SUMS]
        modes = (failure(record)[:, None] == self._modes) & ~record.is_success[:, None]
        rows = torch.cat((torch.ones_like(columns[0])[:, None], torch.stack(columns, dim=-1), modes), dim=-1)
        rows = torch.where(ended[:, None], rows, 0.0)
        self._by_object.index_add_(0, record.object_id, rows)
        maxima = torch.stack([getattr(record, name) for name in MAXIMA], dim=-1)
        torch.maximum(self._maxima, torch.where(ended[:, None], maxima, 0.0).amax(dim=0), out=self._maxima)
        means = torch.cat([values.mean(dim=0) for values in reward_terms.values()])
        self._rewards += torch.cat((torch.ones_like(means[:1]), is_diverged.sum()[None], means))

    def pop(
        self,
        total: Callable[[Tensor], Tensor] = torch.clone,
        largest: Callable[[Tensor], Tensor] = torch.clone,
    ) -> dict[str, float]:
        """Return rates and means since the last call, NaN without episodes; wait for the device.

        `total` adds the sums of all processes, `largest` takes the largest of their maxima.
        """
        buffers = (self._by_object, self._rewards, self._maxima)
        *sums, maxima = (buffer.flatten() for buffer in buffers)
        packed = torch.cat((total(torch.cat(sums)), largest(maxima.clone())))
        objects, rewards, maxima = (
            part.view_as(buffer).tolist()
            for part, buffer in zip(packed.cpu().split([b.numel() for b in buffers]), buffers, strict=True)
        )
        for buffer in buffers:
            buffer.zero_()
        result = _means([sum(column) for column in zip(*objects, strict=True)])
        result |= dict(zip(MAXIMA, maxima, strict=True)) | {"diverged": rewards[1]}
        result |= {
            f"success_rate/{n}": _means(row)["success_rate"]
            for n, row in zip(self._object_names, objects, strict=True)
        }
        names = [f"reward_term/{name}" for names in self._reward_names.values() for name in names]
        return result | {
            name: value / max(rewards[0], 1.0) for name, value in zip(names, rewards[2:], strict=True)
        }


def _means(row: list[float]) -> dict[str, float]:
    episodes = row[0]
    values: dict[str, float] = dict(zip((*SHARES, *SUMS, *SUCCESS_SUMS), row[1:], strict=False))
    failures = dict(zip(FAILURES, row[-len(FAILURES) :], strict=True))
    return {
        "episodes": episodes,
        "tracking_rate": _ratio(values["is_tracked"], episodes),
        **{f"{name}_rate": _ratio(values[f"is_{name}"], episodes) for name in RATES},
        "mean_penetration": _ratio(values["penetration_sum"], values["contact_steps"]),
        **{name: _ratio(values[name], values["is_success"]) for name in SUCCESS_SUMS},
        "episode_steps": _ratio(values["steps"], episodes),
        **{f"failure/{name}": _ratio(count, episodes) for name, count in failures.items()},
    }


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
