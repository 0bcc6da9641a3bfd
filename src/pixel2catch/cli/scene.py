"""`pixel2catch scene`: write the MuJoCo model to a file."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Write the MuJoCo model of robot, table, camera and object to a file.

    Attributes:
        file: Where to write: FILE.xml, self-contained, or FILE.mjb, binary.
        object: Name of the object that is in the scene.
        workcell: Name of the work cell, or a Python file that defines `WORKCELLS`.
    """

    file: Positional[Path]
    object: str = "cube_s"
    workcell: str = "ur5e_allegro"

    def run(self) -> None:
        """Write the file."""
        from pixel2catch.scene.scene import SceneCfg, export

        export(self.file, SceneCfg(workcell=self.workcell, visuals=True), self.object)
        print(f"wrote {self.file}")
