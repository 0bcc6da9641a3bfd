"""The page for labels: what browsers ask for, saved at once, and a person who labels in a real one."""

import _thread
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin

from domains import PATIENCE, free_port
from pixel2catch.cli.main import main
from pixel2catch.perception.labels import Label, Labels
from pixel2catch.rendering.video import VideoWriter
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.images import jpeg
from pixel2catch.viewer.label_page import Frame, LabelPage

WIDTH, HEIGHT, NUM = 320, 180, 12
EMPTY = Labels(video="throw.mp4", width=WIDTH, height=HEIGHT, rate=30.0)

PAGE_PATIENCE = 60.0
"""Time after which a step in a browser counts as failed [s]. Beside three busy loops on two cores the longest
move of a mouse took 0.7 s."""


def picture(number: int) -> np.ndarray:
    """A white square that moves to the right."""
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    left = 20 + 10 * number
    image[40:60, left : left + 20] = 230
    return image


def true_box(number: int) -> list[float]:
    return [20.0 + 10 * number, 40.0, 40.0 + 10 * number, 60.0]


@pytest.fixture
def page(tmp_path: Path) -> Iterator[LabelPage]:
    images = {i: Frame(time=i / 30.0, jpeg=jpeg(picture(i))) for i in range(NUM)}
    page = LabelPage(PageCfg(port=free_port()), images, EMPTY, tmp_path / "labels.json")
    yield page
    page.close()


def until(is_true: Callable[[], Any]) -> None:
    end = time.monotonic() + PATIENCE
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.001)


class Browser:
    """What the page's script says and hears."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self.state = self.hear()

    def hear(self) -> dict[str, Any]:
        while isinstance(said := self._connection.recv(PATIENCE), bytes):
            pass
        return json.loads(said)

    def ask(self, do: str, **more: Any) -> dict[str, Any]:
        self._connection.send(json.dumps({"do": do, **more}))
        return self.hear()


@pytest.fixture
def browser(page: LabelPage) -> Iterator[Browser]:
    origin = Origin(page.address.removesuffix("/label"))
    link = f"{page.address.replace('http', 'ws')}/link"
    with connect(link, origin=origin, open_timeout=PATIENCE) as connection:
        yield Browser(connection)


def test_every_change_is_saved_at_once(page: LabelPage, browser: Browser, tmp_path: Path):
    path = tmp_path / "labels.json"
    assert browser.state["image"] == 0
    browser.ask("label", image=0, phase="held", box=true_box(0))
    assert Labels.load(path).images[0].box == tuple(true_box(0))
    browser.ask("label", image=4, phase="flight", box=true_box(4))
    assert browser.ask("show", image=2)["suggested"] == true_box(2)
    browser.ask("fill", image=3)
    assert [list(each.box or ()) for each in Labels.load(path).images] == [true_box(i) for i in range(5)]
    browser.ask("forget", image=1)
    browser.ask("label", image=2, phase="flight", box=None)
    state = browser.ask("name", object="white square")
    assert state["labelled"] == [
        [0, "held", True],
        [2, "flight", False],
        [3, "flight", True],
        [4, "flight", True],
    ]
    saved = Labels.load(path)
    assert (saved.object, saved.images[1].box) == ("white square", None)
    assert saved.images[2].time == pytest.approx(0.1)


def test_what_cannot_be_is_said_and_changes_nothing(page: LabelPage, browser: Browser, tmp_path: Path):
    for asked, words in (
        ({"do": "label", "image": 99, "phase": "held", "box": None}, "there is no image 99"),
        ({"do": "label", "image": 1, "phase": "up", "box": None}, "must be one of held, flight"),
        ({"do": "label", "image": 1, "phase": "held", "box": [1, 2, 3]}, "is no box"),
        ({"do": "label", "image": 1, "phase": "held", "box": [9, 9, 5, 5]}, "xmin, ymin, xmax, ymax"),
        ({"do": "label", "image": 1, "phase": "held", "box": [0, 0, 5, 999]}, "320 by 180"),
        ({"do": "fill", "image": 3}, "to fill, label"),
        ({"do": "jump"}, "is none of show, label"),
    ):
        assert words in browser.ask(asked.pop("do"), **asked)["error"]
    assert page.labels == EMPTY
    assert not (tmp_path / "labels.json").exists()
    assert browser.ask("show", image=10_000)["image"] == NUM - 1


def test_a_person_labels_in_a_browser(page: LabelPage, browser_page: Any, tmp_path: Path):
    wrong: list[str] = []
    browser_page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    browser_page.on("pageerror", lambda error: wrong.append(str(error)))
    browser_page.set_default_timeout(1000 * PAGE_PATIENCE)
    browser_page.goto(page.address)
    image, place = browser_page.locator("#image"), browser_page.locator("#place")
    place.filter(has_text="not labelled").wait_for()
    frame = image.bounding_box()
    scale = min(frame["width"] / WIDTH, frame["height"] / HEIGHT)
    left, top = 0.5 * (frame["width"] - scale * WIDTH), 0.5 * (frame["height"] - scale * HEIGHT)

    def see(do: Callable[[], None]) -> None:
        """Do something, and wait until the page shows what came of it."""
        before = place.text_content()
        do()
        place.filter(has_not_text=before).wait_for()

    def press(key: str) -> None:
        see(lambda: image.press(key))

    def drag(*ends: tuple[float, float]) -> None:
        start, end = ({"x": left + scale * x, "y": top + scale * y} for x, y in ends)
        see(lambda: image.drag_to(image, source_position=start, target_position=end))

    drag((20, 40), (40, 60))
    assert page.labels.images[0].box == pytest.approx(true_box(0), abs=1.0)
    press("ArrowRight")
    image.press("f")  # shows with the next box
    drag((30, 40), (50, 55))
    drag((50, 55), (50, 60))  # the lower right corner
    assert page.labels.images[1].box == pytest.approx(true_box(1), abs=1.0)
    press("ArrowRight")
    press("Enter")  # as it moved last
    before = page.labels.images[2].box
    assert before == pytest.approx(true_box(2), abs=2.0)
    press("d")
    assert page.labels.images[2].box != before
    browser_page.locator("#object").fill("white square")
    browser_page.locator("#object").press("Enter")  # heeded before the keys that follow
    press("Shift+ArrowRight")
    assert f"image {NUM - 1} of" in place.text_content()
    press("n")
    saved = Labels.load(tmp_path / "labels.json")
    assert saved == page.labels
    assert saved.object == "white square"
    assert [(each.phase, each.box is None) for each in saved.images] == [
        ("held", False),
        ("flight", False),
        ("flight", False),
        ("flight", True),
    ]
    assert wrong == []


def test_the_command_goes_on_with_a_file_and_ends_with_ctrl_c(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with VideoWriter(tmp_path / "throw.mp4", fps=30) as video:
        for number in range(NUM):
            video.write(picture(number))
    EMPTY.with_label(Label(image=4, time=4 / 30.0, phase="held", box=None)).save(tmp_path / "throw.json")
    port = free_port()

    def visit() -> None:
        """Label an image, and do what Ctrl-C does."""
        until(lambda: "open http://" in "".join(said))
        with connect(f"ws://127.0.0.1:{port}/label/link", origin=Origin(f"http://127.0.0.1:{port}")) as link:
            visitor = Browser(link)
            assert (visitor.state["first"], visitor.state["last"], visitor.state["image"]) == (3, 9, 4)
            visitor.ask("label", image=6, phase="flight", box=true_box(6))
        _thread.interrupt_main()

    said: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pixel2catch.cli.label.say", said.append)
        visiting = threading.Thread(target=visit, daemon=True)
        visiting.start()
        options = ["--at", "0.1", "--seconds", "0.2", "--object", "square", "--port", str(port)]
        assert main(["label", str(tmp_path / "throw.mp4"), *options]) == 0
        visiting.join()
    saved = Labels.load(tmp_path / "throw.json")
    assert [each.image for each in saved.images] == [4, 6]
    assert saved.object == "square"


def test_a_video_that_cannot_be_labelled_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with VideoWriter(tmp_path / "throw.mp4", fps=30) as video:
        video.write(picture(0))
    replace(EMPTY, width=640, height=480).save(tmp_path / "other.json")
    for args, words in (
        (["nothing.mp4"], "there is no file 'nothing.mp4'"),
        ([str(tmp_path / "throw.mp4"), "--at", "9"], "has no image after 9 s"),
        (
            [str(tmp_path / "throw.mp4"), "--out", str(tmp_path / "other.json")],
            "are for images of 640 by 480",
        ),
    ):
        assert main(["label", *args]) == 2
        assert words in capsys.readouterr().err
