"""`d2 protocol`: a published evaluation is one command; it says what differs, and repeats to the last digit."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from at_once import measured_at_once
from stand_in_recordings import renamed, write_rows

from d2_plugin.commands.cli import main
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.images import write_png
from d2_plugin.recordings.presets import camera_split
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.metrics import METRICS
from d2_plugin.runs.protocols import PROTOCOLS, differences
from d2_plugin.runs.rows import read_rows

N3DV = tuple(f"cam{i:02d}" for i in range(21))
USED = ("cam00", "cam04", "cam09", "cam12", "cam17")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room as N3DV lays out its scenes: poses_bounds.npy, and the frames of cam00 to cam20, black if unused."""
    pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    room = synthetic_recording(cameras=21, held_out=0, frames=2, width=64, height=48)
    room = renamed(room, N3DV, near_far=(1.0, 9.0))
    path = tmp_path_factory.mktemp("n3dv") / "sear_steak"
    for camera in N3DV:
        (path / camera).mkdir(parents=True)
        for frame in room.frames:
            image = room.image(camera, frame) if camera in USED else np.zeros((48, 64, 3), np.uint8)
            write_png(path / camera / f"{frame:04d}.png", image)
    return write_rows(room, path)


def test_a_protocol_says_what_differs_and_repeats_to_the_last_digit_and_only_what_is_not_there(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["protocol", "gc-4dgs-4", str(scene), "--iterations", "8", "--jobs", "1"]
    for name, methods in (("once", "backbone,full"), ("again", "backbone"), ("again", "backbone")):
        with measured_at_once():
            assert main([*words, "--methods", methods, "--output", str(tmp_path / name)]) == 0
    printed = capsys.readouterr().out
    first, second = (read_rows([tmp_path / name / "training.jsonl"]) for name in ("once", "again"))
    assert [row["method"] for row in first] == ["yang4d backbone", "yang4d full"]
    assert [row["method"] for row in second] == ["yang4d backbone"], "what is there is not measured again"
    assert (first[0]["scores"], first[0]["gaussians"]) == (second[0]["scores"], second[0]["gaussians"])
    assert first[0]["protocol"] == "protocol:gc-4dgs-4"
    assert first[0]["size"] == [64, 48]
    assert first[0]["metrics"]["ssim2"] == METRICS["ssim2"].variant
    assert "trains on cam04, cam09, cam12, cam17, scores cam00; 64x48 pixels, 2 frames, 8 steps" in printed
    for line in ("images: published 1352x1014, here 64x48", "frames: published 300, here 2", "starting points: "):
        assert f"not as published: {line}" in printed
    assert "intrinsics" not in printed


def test_cameras_of_one_focal_length_each_are_told_apart_from_one_for_all(scene: Path) -> None:
    """Published code gives the first camera's intrinsics to all."""
    whole = open_recording(scene)
    wider = whole.cameras["cam09"].K.copy()
    wider[0, 0] *= 1.02
    cameras = whole.cameras | {"cam09": replace(whole.cameras["cam09"], K=wider)}
    lines = list(differences(PROTOCOLS["gc-4dgs-4"], replace(whole, cameras=cameras), ("cam04", "cam09"), 10_000))
    assert "intrinsics: published those of cam00 for all; here each camera's, up to 2.00% apart" in lines
    assert not [line for line in lines if line.startswith("iterations")]


@pytest.mark.parametrize("name", PROTOCOLS)
def test_every_protocol_has_cameras_and_metrics_that_there_are(name: str, scene: Path) -> None:
    protocol = PROTOCOLS[name]
    assert camera_split(open_recording(scene), protocol.cameras).train
    assert set(protocol.metrics) <= set(METRICS)


@pytest.mark.parametrize(
    ("words", "said"),
    [(("gc-4dgs4", "x"), "did you mean 'gc-4dgs-4'"), (("4c4d", "a@b/c"), "rename a folder"), (("4c4d",), "needs")],
)
def test_what_cannot_be_is_one_sentence(words: tuple[str, ...], said: str, refused: Callable[..., str]) -> None:
    assert said in refused("protocol", *words)
