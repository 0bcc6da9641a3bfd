"""The contract of a policy: inputs and outputs of its networks, camera, work cell and action scale.

It is saved with the networks and compared when a policy is loaded; a difference is an error that names the
field.
"""

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, cast

import torch

from pixel2catch.agents import AgentSpec, agents_of, commands_of
from pixel2catch.checks import Meets, Within, require_valid
from pixel2catch.errors import InvalidValueError, PolicyMismatchError, UnknownNameError
from pixel2catch.files import decoded, shown, take_version
from pixel2catch.mdp import observations, rewards
from pixel2catch.mdp.control_step import BoxHistory, Measurement
from pixel2catch.mdp.observations import ObservationInputs, ObservationTerm
from pixel2catch.mdp.rewards import RewardTerm
from pixel2catch.methods import METHODS, Method, find_method, remembering
from pixel2catch.own_files import OPTION, computed, import_files
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, OBJECT_RADIUS, RGB_CAMERA, CameraSpec
from pixel2catch.workcells import find_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

FORMAT_VERSION = 2  #: Version of the files of `Policy.save`; higher where older files cannot be read.

MOST_LINES, LONGEST_MESSAGE = 8, 2000  #: Lines and characters of a message with the fields that differ.
MOST_AGENTS, MOST_INPUTS = 16, 8192  #: Largest numbers in files. Source: ours; policies have 4 and 200.


@dataclasses.dataclass(frozen=True, kw_only=True)
class AgentContract:
    """Inputs and outputs of one agent's network."""

    observation: tuple[tuple[str, int], ...]  #: Names and sizes of terms, in the order of the input vector.
    joints: tuple[str, ...]  #: Names of the joints, in the order of the output vector.

    @property
    def num_inputs(self) -> int:
        """Return the length of the observation vector."""
        return sum(size for _, size in self.observation)


def _are_few(agents: Mapping[str, AgentContract]) -> bool:
    return 1 <= len(agents) <= MOST_AGENTS and all(1 <= a.num_inputs <= MOST_INPUTS for a in agents.values())


FEW = Meets(_are_few, f"give 1 to {MOST_AGENTS} agents, with 1 to {MOST_INPUTS} inputs each")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """Inputs, outputs and surroundings of a policy."""

    method: str  #: Name of the method.
    pixel_features: tuple[str, ...]  #: Names of the pixel features, in their order within a frame.
    agents: Annotated[dict[str, AgentContract], FEW]  #: The agents by name.
    #: How an action becomes a joint target, by joint: the fields of its `JointCommand` [rad].
    commands: dict[str, dict[str, float]]
    control_dt: float  #: Time between two actions [s].
    #: The fields of its `CameraSpec`: size and intrinsics [px], position [m], orientation; of a policy for
    #: any camera the size alone.
    camera: dict[str, int | float | tuple[float, ...]]
    workcell: str  #: Name of the work cell.
    task: str = "nominal"  #: Name of the task of its training; it may act in others.
    #: Of a ball with the volume of the largest object of training [m].
    object_radius: Annotated[float, Within(0.0, 1.0, is_open=True)] = OBJECT_RADIUS
    format_version: int = FORMAT_VERSION  #: Version of the file format.

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, lists and numbers, ready for JSON."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "PolicyContract":
        """Read what `to_dict` returned; raise PolicyMismatchError if it does not fit this code."""
        content, fix = dict(data), "train again, or use the version of this package that wrote the policy"
        try:
            take_version(content, FORMAT_VERSION)
            require_valid(contract := decoded(cls, content))
            return contract
        except InvalidValueError as error:
            raise PolicyMismatchError(f"policy: {error}; {fix}.") from error

    def require(self, expected: "PolicyContract") -> None:
        """Compare with the contract of robot and camera at hand; PolicyMismatchError says what differs."""
        same_task = dataclasses.replace(expected, task=self.task, object_radius=self.object_radius)
        ours, theirs = dict(leaves(self.to_dict())), dict(leaves(same_task.to_dict()))
        fields = [name for name in ours | theirs if ours.get(name) != theirs.get(name)]
        if fields:
            lines = [f"  {name}: policy {ours.get(name)!r}, here {theirs.get(name)!r}" for name in fields]
            fix = "the policy does not fit; give one with the values here, or train it:\n"
            if all(name.startswith("camera.") for name in fields):
                fix = "the policy is for another camera; leave out --camera if yours stands at that place, "
                fix += "take catch_alone+anycamera, or train it for yours:\n"
            rest = f"\n  {len(fields)} fields differ" if len(fields) > MOST_LINES else ""
            raise PolicyMismatchError(fix + "\n".join(lines[:MOST_LINES])[:LONGEST_MESSAGE] + rest)


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of nested mappings."""
    if isinstance(value, Mapping) and value:
        for key, entry in value.items():
            yield from leaves(entry, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


def contract_of(
    method: Method, workcell: WorkcellSpec = UR5E_ALLEGRO, camera: CameraSpec = RGB_CAMERA
) -> PolicyContract:
    """Return the contract of policies of a method for a work cell and a camera."""
    return PolicyContract(
        method=method.name,
        pixel_features=method.pixel_features,
        agents={agent.name: _agent_contract(agent, method, workcell) for agent in method.agents},
        commands={
            joint.name: dataclasses.asdict(command)
            for joint, command in zip(workcell.joints, commands_of(workcell), strict=True)
        },
        control_dt=CONTROL_DT,
        camera={
            name: value
            for name, value in dataclasses.asdict(camera).items()
            if name in ("width", "height") or not method.is_levelled
        },
        workcell=workcell.name,
    )


def _agent_contract(agent: AgentSpec, method: Method, workcell: WorkcellSpec) -> AgentContract:
    """List two consecutive frames, oldest first, then the memory, as in `Method.observe`."""
    blank = _blank_measurement(method.num_boxes, workcell)
    frame = method.inputs(agent, blank, blank)
    frames = [(term, when) for when in ("t-1", "t") for term in agent.observation]
    terms = [*frames, *((term, "t") for term in agent.memory)]
    sizes = [computed("observation term", t, (frame,), 1, "any", is_blank=True).shape[1] for t, _ in terms]
    names = [f"{term.__name__}[{when}]" for term, when in terms]
    return AgentContract(
        observation=tuple(zip(names, sizes, strict=True)),
        joints=tuple(joint.name for columns in agent.joints for joint in workcell.joints[columns]),
    )


def _blank_measurement(num_boxes: int, workcell: WorkcellSpec) -> Measurement:
    joints, num_palms = torch.zeros(1, len(workcell.joints)), len(workcell.palms)
    return Measurement(
        boxes=BoxHistory.begun(torch.zeros(1, 4), torch.zeros(1), num_boxes),
        camera_pos=torch.zeros(1, 3),
        object_pos=torch.zeros(1, 3),
        initial_object_pos=torch.zeros(1, 3),
        joint_pos=joints,
        joint_pos_target=joints,
        palm_pos=torch.zeros(1, num_palms, 3),
        palm_quat=torch.zeros(1, num_palms, 4),
        action=joints,
    )


def unmeasured_terms(method: Method, workcell: WorkcellSpec) -> list[str]:
    """Return the names of a method's terms that read the object's position, which no camera measures."""
    blank = _blank_measurement(method.num_boxes, workcell)
    unknown = torch.full_like(blank.object_pos, torch.nan)
    lost = dataclasses.replace(blank, object_pos=unknown, initial_object_pos=unknown)
    return [
        term.__name__
        for agent in method.agents
        for term in (*agent.observation, *agent.memory)
        for seen, unseen in [(term(method.inputs(agent, each, each)) for each in (blank, lost))]
        if (unseen.isnan() & ~seen.isnan()).any()
    ]


def method_of(contract: PolicyContract) -> Method:
    """Return the method of a policy by its name, or else made from its contract, without rewards.

    Raises PolicyMismatchError for a contract with terms that are not of this package.
    """
    import_files()
    workcell = find_workcell(contract.workcell)
    base, _, memory = contract.method.partition("+")
    if base in METHODS:
        return find_method(contract.method, workcell)
    with contextlib.suppress(LookupError, RuntimeError, UnknownNameError):
        agents = tuple(_agent(name, each, workcell) for name, each in contract.agents.items())
        method = Method(name=base, agents=agents, pixel_features=contract.pixel_features)
        method = remembering(method, memory) if memory else method
        if contract_of(method, workcell).agents == contract.agents:
            return method
    raise PolicyMismatchError(
        f"unknown method {shown(contract.method)}, and its policy observes or remembers what is not of this "
        f"package; name the Python file that registers it: pixel2catch {OPTION} FILE.py COMMAND ... "
        f"Methods of this package: {', '.join(METHODS)}."
    )


def _agent(name: str, contract: AgentContract, workcell: WorkcellSpec) -> AgentSpec:
    terms = {
        term_name: cast(ObservationTerm, term)
        for term_name, term in vars(observations).items()
        if getattr(term, "__annotations__", {}).get("frame") is ObservationInputs
    }
    no_reward = RewardTerm(function=rewards.elapsed_time, weight=0.0)
    parts = tuple(
        dataclasses.replace(part, reward=(no_reward,))
        for agent in agents_of(workcell)
        for part in agent.parts
        if workcell.joints[part.joints][0].name in contract.joints
    )
    frame = (term.removesuffix("[t-1]") for term, _ in contract.observation if term.endswith("[t-1]"))
    return AgentSpec(name=name, parts=parts, observation=tuple(terms[each] for each in frame))
