"""`pixel2catch scene`: write the MuJoCo model to a file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from pixel2catch.checks import OutputFile, RobotModelPath


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Write the MuJoCo model of robot, table, camera and object to a file."""

    #: Where to write: FILE.xml, self-contained, or FILE.mjb, binary.
    file: Positional[Annotated[Path, OutputFile((".xml", ".mjb"))]]
    object: str = "cube_s"  #: Name of the object that is in the scene.
    workcell: str = "ur5e_allegro"  #: Name of the work cell, or a Python file that defines `WORKCELLS`.

    #: Makers' models of arm, hand or both, URDF or MJCF, in place of the package's; prints how their axes
    #: differ.
    robot_model: tuple[RobotModelPath, ...] = ()

    def run(self) -> None:
        """Write the file."""
        from pixel2catch.robots.maker import maker_parts
        from pixel2catch.scene.scene import SceneCfg, export
        from pixel2catch.workcells import find_workcell

        files = tuple(map(str, self.robot_model))
        cfg = SceneCfg(workcell=self.workcell, visuals=True, robot_model=files)
        export(self.file, cfg, self.object)
        for (prefix, name), part in maker_parts(find_workcell(self.workcell), files, "collision").items():
            difference = f"{1e3 * part.distance:.2f} mm and {1e3 * part.angle:.2f} mrad"
            print(f"{prefix}{name}: axes differ from the package's model by at most {difference}")
        print(f"wrote {self.file}")
