"""How far is our body from the makers' models: frames, masses, joint inertia, surfaces, self-contact?

The makers' models are not part of this project; give the paths of your copies, URDF or MJCF, with their
meshes at the paths that they name. Joints are told apart by their order in the tree, fingers by where their
roots are, so that names do not matter, but for the arm's base and tool.
* arm: pose of the tool, centres of mass, inertia and gravity torques of the joints, at random positions;
* hand: places of the last links at random positions, masses, extents of every link in its own frame, and how
  many random hand positions, within our limits, have a contact between fingers or with the palm. Where a
  model has no masses, those shown are of its shapes filled with water.
Surfaces are the maker's collision shapes, or with `--surface visual` the convex hulls of what is drawn.
Run: python benchmarks/body_against_maker.py --arm ur5e.urdf --hand allegro_hand_left.urdf
"""

import argparse
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from pixel2catch.robots.allegro import HAND, PALM, Handedness
from pixel2catch.robots.ur5e import UR5E
from pixel2catch.robots.workcell import robot_mjcf
from pixel2catch.scene.scene import SceneCfg, build_model

SAMPLES = 200
POSES = 2000
CHAIN = 4
"""Bodies of a finger."""

Surface = Literal["collision", "visual"]

FINGERS = tuple(finger.name for finger in PALM.fingers)


def load(path: str, surface: Surface) -> mujoco.MjModel:
    """Compile a maker's model, with the surfaces that are asked for as those that collide."""
    text = Path(path).read_text(encoding="utf-8")
    if surface == "visual":  # a URDF's are dropped while it is read
        keep = '<mujoco><compiler discardvisual="false"/></mujoco></robot>'
        text = text.replace("</robot>", keep)
    spec = mujoco.MjSpec.from_string(text)
    spec.modelfiledir = str(Path(path).parent)
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = True  # the hand's maker publishes impossible ones
    if surface == "visual":
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = int(geom.contype == 0 and geom.conaffinity == 0)
    return spec.compile()


def pose(data: mujoco.MjData, body: int) -> np.ndarray:
    """Homogeneous pose of a body in the world."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return matrix


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Inertia of the joints, without drives [kg·m²]."""
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full - np.diag(model.dof_armature)


def report(name: str, value: str) -> None:
    """One line."""
    print(f"{name:44} {value}")


def compare_arms(path: str) -> None:
    """The arm without a hand."""
    ours, theirs = robot_mjcf(UR5E, visuals=False).compile(), load(path, "collision")
    ours.body_gravcomp[:] = 0.0
    moving = [sorted(set(m.jnt_bodyid.tolist())) for m in (ours, theirs)]
    report("masses of the links, ours [kg]", np.array2string(ours.body_mass[moving[0]]))
    report("masses of the links, maker's [kg]", np.array2string(theirs.body_mass[moving[1]]))
    worst = dict.fromkeys(
        ("tool0 [mm]", "centre of mass [mm]", "joint inertia [%]", "gravity torque [N m]"), 0.0
    )
    for joint_pos in np.random.default_rng(0).uniform(-np.pi, np.pi, (SAMPLES, 6)):
        tools, centers, inertias, torques = zip(
            *(
                _arm_at(model, bodies, joint_pos)
                for model, bodies in zip((ours, theirs), moving, strict=True)
            ),
            strict=True,
        )
        gaps = (
            1e3 * np.linalg.norm(tools[0] - tools[1]),
            1e3 * np.linalg.norm(centers[0] - centers[1], axis=1).max(),
            100 * np.abs(inertias[0] / inertias[1] - 1).max(),
            np.abs(torques[0] - torques[1]).max(),
        )
        worst = {name: max(value, float(gap)) for (name, value), gap in zip(worst.items(), gaps, strict=True)}
    for name, value in worst.items():
        report(f"largest difference of {name}", f"{value:.4f}")


def _arm_at(model: mujoco.MjModel, bodies: list[int], joint_pos: np.ndarray) -> tuple[np.ndarray, ...]:
    """Tool and centres of mass seen from the base [m], inertias of the joints, torques of gravity."""
    data = mujoco.MjData(model)
    data.qpos[:] = joint_pos
    mujoco.mj_forward(model, data)
    base = pose(data, model.body("base_link").id)
    has_site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "tool0") >= 0
    tool = (data.site("tool0") if has_site else data.body("tool0")).xpos
    points = (np.vstack((tool, data.xipos[bodies])) - base[:3, 3]) @ base[:3, :3]
    return points[0], points[1:], np.diag(mass_matrix(model, data)), data.qfrc_bias.copy()


@dataclass(frozen=True)
class Hand:
    """A hand in a model.

    Attributes:
        model: The model.
        palm: The body that the fingers are on.
        links: Bodies of each finger from the root to the last, what is welded to each of them included.
        joints: Addresses of positions of each finger's joints; the maker's fingers have one more than ours.
    """

    model: mujoco.MjModel
    palm: int
    links: dict[str, list[list[int]]]
    joints: dict[str, list[int]]

    def place(self, hand_pos: np.ndarray) -> mujoco.MjData:
        """Data with our hand joints at these positions [rad], and contacts found."""
        data = mujoco.MjData(self.model)
        rest = list(hand_pos)
        for finger in FINGERS:
            count = 4 if finger == "thumb" else 3
            data.qpos[self.joints[finger][-count:]] = rest[:count]
            rest = rest[count:]
        mujoco.mj_fwdPosition(self.model, data)
        return data

    def part_of(self, body: int) -> tuple[str, int]:
        """Finger and index of a link, or palm and 0."""
        for finger, links in self.links.items():
            for i, bodies in enumerate(links):
                if body in bodies:
                    return finger, i
        return "palm", 0


def our_hand(handedness: Handedness) -> Hand:
    """Ours, in the complete scene."""
    model = build_model(SceneCfg(workcell="ur5e_allegro" if handedness == "left" else "ur5e_allegro_right"))
    links = {name: [[model.body(f"{name}_link_{i}").id] for i in range(CHAIN)] for name in FINGERS}
    joints = {
        name: [
            int(model.joint(joint.name).qposadr[0]) for joint in HAND.joints if joint.name.startswith(name)
        ]
        for name in FINGERS
    }
    return Hand(model, model.body("palm").id, links, joints)


def maker_hand(path: str, surface: Surface, like: Hand) -> Hand:
    """The maker's; a finger is the one of ours whose root is nearest, seen from the middle of all roots."""
    model = load(path, surface)
    moving = {int(body): i for i, body in enumerate(model.jnt_bodyid)}
    roots = [body for body in moving if model.body_parentid[body] not in moving]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    palm = int(model.body_parentid[roots[0]])
    theirs = _seen_from(pose(data, palm), data, roots)
    home = like.place(np.array([joint.home for joint in HAND.joints]))
    ours = _seen_from(pose(home, like.palm), home, [like.links[name][0][0] for name in FINGERS])
    links, joints = {}, {}
    for finger, spot in zip(FINGERS, ours - ours.mean(0), strict=True):
        away = np.linalg.norm(theirs - theirs.mean(0) - spot, axis=1)
        chain = [roots[int(away.argmin())]]
        print(f"{finger}: root within {1e3 * away.min():.2f} mm of the maker's {model.body(chain[0]).name}")
        while len(chain) < CHAIN:
            chain.append(next(b for b in moving if model.body_parentid[b] == chain[-1]))
        welded = [[b for b in range(model.nbody) if model.body_weldid[b] == link] for link in chain]
        links[finger] = welded
        joints[finger] = [int(model.jnt_qposadr[moving[body]]) for body in chain]
    return Hand(model, palm, links, joints)


def _seen_from(frame: np.ndarray, data: mujoco.MjData, bodies: list[int]) -> np.ndarray:
    """Positions of bodies in a frame [m]."""
    return (data.xpos[bodies] - frame[:3, 3]) @ frame[:3, :3]


def extents(hand: Hand, data: mujoco.MjData, finger: str, index: int) -> np.ndarray:
    """How far the surface of a link reaches along -x, x, -y, y, -z, z of its frame [mm]."""
    model, bodies = hand.model, hand.links[finger][index]
    frame = pose(data, bodies[0])
    points = [
        _outline(model, geom, way, data, frame)
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] in bodies and model.geom_contype[geom]
        for way in np.concatenate((np.eye(3), -np.eye(3)))
    ]
    if not points:
        return np.full(6, np.nan)
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    return 1e3 * np.column_stack((low, high)).ravel()


def _outline(
    model: mujoco.MjModel, geom: int, way: np.ndarray, data: mujoco.MjData, frame: np.ndarray
) -> np.ndarray:
    """The point of a geom that is farthest along `way` of the frame, in that frame [m]."""
    turn, size = data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
    local = turn.T @ frame[:3, :3] @ way
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        point = vertices[(vertices @ local).argmax()]
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        point = np.sign(local) * size
    elif kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
        half = size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
        point = np.array((0.0, 0.0, np.sign(local[2]) * half)) + size[0] * local
    else:
        raise SystemExit(f"a geom is a {kind.name}; only meshes, boxes, spheres and capsules can be measured")
    return frame[:3, :3].T @ (data.geom_xpos[geom] + turn @ point - frame[:3, 3])


def self_contacts(hand: Hand, poses: np.ndarray) -> Counter[str]:
    """In how many positions which parts touch, but for housings at the palm and links of one finger."""
    counts = Counter[str]()
    for hand_pos in poses:
        touching = set[str]()
        data = hand.place(hand_pos)
        for contact in data.contact:
            bodies = hand.model.geom_bodyid[[contact.geom1, contact.geom2]]
            (first, i), (second, j) = sorted(hand.part_of(int(body)) for body in bodies)
            is_root = "palm" in (first, second) and (i + j < 2)
            if first != second and not is_root and not (i == 0 and j == 0):
                touching.add(f"{first} and {second}")
        counts.update(touching)
        counts["any"] += bool(touching)
    return counts


def compare_hands(path: str, handedness: Handedness, surface: Surface) -> None:
    """The hand alone, the arm of ours at rest."""
    ours = our_hand(handedness)
    theirs = maker_hand(path, surface, ours)
    low, high = np.array([(joint.lower, joint.upper) for joint in HAND.joints]).T
    poses = np.random.default_rng(0).uniform(low, high, (POSES, len(HAND.joints)))
    for finger in FINGERS:
        gaps = [
            np.linalg.norm(last_link(ours, hand_pos, finger) - last_link(theirs, hand_pos, finger))
            for hand_pos in poses[:SAMPLES]
        ]
        report(f"largest gap of the last link, {finger} [mm]", f"{1e3 * max(gaps):.3f}")
    print("\nlink            mass [g]      reach along -x, x, -y, y, -z, z [mm]: ours | maker's")
    data = [hand.place(np.zeros(len(HAND.joints))) for hand in (ours, theirs)]
    for finger in ("index", "thumb"):
        for i in range(CHAIN):
            masses = [1e3 * hand.model.body_mass[hand.links[finger][i]].sum() for hand in (ours, theirs)]
            sizes = [extents(hand, d, finger, i) for hand, d in zip((ours, theirs), data, strict=True)]
            texts = [" ".join(f"{value:6.1f}" for value in size) for size in sizes]
            print(f"{finger}_link_{i:<2}  {masses[0]:6.1f} {masses[1]:6.1f}   {texts[0]} | {texts[1]}")
    print(f"\nself-contact in {POSES} random hand positions: ours, maker's")
    counts = [self_contacts(hand, poses) for hand in (ours, theirs)]
    for name in sorted(counts[0] | counts[1]):
        report(name, f"{counts[0][name]:5} {counts[1][name]:5}")


def last_link(hand: Hand, hand_pos: np.ndarray, finger: str) -> np.ndarray:
    """Position of a finger's last joint in axes of the palm, from the root of the middle finger [m]."""
    data = hand.place(hand_pos)
    bodies = [hand.links[finger][-1][0], hand.links["middle"][0][0]]
    tip, root = _seen_from(pose(data, hand.palm), data, bodies)
    return tip - root


def main() -> None:
    """Compare with the models that are given."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", help="the maker's UR5e: URDF or MJCF with bodies base_link and tool0")
    parser.add_argument("--hand", help="the maker's Allegro hand: URDF or MJCF")
    parser.add_argument("--handedness", choices=("left", "right"), default="left")
    parser.add_argument("--surface", choices=("collision", "visual"), default="collision")
    args = parser.parse_args()
    if args.arm:
        compare_arms(args.arm)
    if args.hand:
        compare_hands(args.hand, args.handedness, args.surface)


if __name__ == "__main__":
    main()
