"""`pixel2catch scene`: write the MuJoCo model."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from pixel2catch.checks import OutputFile


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Write the MuJoCo model, for any MuJoCo viewer."""

    #: Where to write: FILE.xml, self-contained, or FILE.mjb, binary.
    file: Positional[Annotated[Path, OutputFile((".xml", ".mjb"))]]
    object: str = "cube_s"  #: Name of the object that is in the scene.
    workcell: str = "ur5e_allegro"  #: Name of the work cell.

    def run(self) -> None:
        from pixel2catch.scene.scene import SceneCfg, export

        export(self.file, SceneCfg(workcell=self.workcell, visuals=True), self.object)
        print(f"wrote {self.file}")
