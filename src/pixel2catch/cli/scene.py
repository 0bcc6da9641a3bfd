"""`pixel2catch scene`: write the MuJoCo model, or which throws a camera sees."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from pixel2catch.checks import CameraPath, OutputFile
from pixel2catch.errors import InvalidValueError


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Write the MuJoCo model, or a chart of the throws a camera sees."""

    #: Where to write: FILE.xml, self-contained, or FILE.mjb, binary; with --camera FILE.png.
    file: Positional[Annotated[Path, OutputFile((".xml", ".mjb", ".png"))]]
    object: str = "cube_s"  #: Name of the object that is in the scene.
    workcell: str = "ur5e_allegro"  #: Name of the work cell, or a Python file that defines `WORKCELLS`.
    #: Camera file, as `calibrate` writes it, or the name release or people. Which throws this camera sees is
    #: printed, and drawn into FILE.png.
    camera: CameraPath | None = None

    def run(self) -> None:
        if (self.camera is None) == (self.file.suffix.lower() == ".png"):
            raise InvalidValueError(
                "a .png shows what a --camera sees; give both, or FILE.xml or FILE.mjb alone."
            )
        if self.camera is not None:
            self._draw_sight(self.camera)
        else:
            from pixel2catch.scene.scene import SceneCfg, export

            export(self.file, SceneCfg(workcell=self.workcell, visuals=True), self.object)
        print(f"wrote {self.file}")

    def _draw_sight(self, path: Path) -> None:
        from pixel2catch.camera.camera_file import CameraFile
        from pixel2catch.envs.tasks import PEOPLE_THROWS
        from pixel2catch.evaluation.sight import chart, sight
        from pixel2catch.files import write_atomically
        from pixel2catch.mdp.throws import ThrowCfg

        camera = CameraFile.load(path).camera
        for name, throws in (("the paper's throws", ThrowCfg()), ("throws of people", PEOPLE_THROWS)):
            found = sight(camera, throws)
            print(
                f"{name}: {found.share:.0%} of a flight is in view, all of it in {found.whole:.0%} of the "
                f"throws, the catch in {found.catch:.0%}; {found.time:.2f} s from first sight to catch; "
                f"{found.release_size:.1f} px/cm at the release, {found.catch_size:.1f} at the catch"
            )
        write_atomically({self.file: chart(camera)})
