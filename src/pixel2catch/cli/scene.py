"""`pixel2catch scene`: write the MuJoCo model to a file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Write the MuJoCo model of robot, table, camera and object to a file.

    Attributes:
        file: Where to write: FILE.xml, self-contained, or FILE.mjb, binary.
        object: Name of the object that is in the scene.
        handedness: Which hand is on the arm.
    """

    file: Positional[Path]
    object: str = "cube_s"
    handedness: Literal["left", "right"] = "left"

    def run(self) -> None:
        """Write the file."""
        from pixel2catch.robot.scene import SceneCfg, export

        export(self.file, SceneCfg(handedness=self.handedness, visuals=True), self.object)
        print(f"wrote {self.file}")
