"""`d2 demo` goes on where it was cut off."""

from __future__ import annotations

from pathlib import Path

import pytest
from oracles.export_files import ReadPage

from d2_plugin.commands.cli import main
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export import folder as folder_layout
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.viewing import demo

pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
pytest.importorskip("cv2", reason="opencv is in the `image` extra")


class Stopped(BaseException):
    """Raised where a test ends the demo."""


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The demo on a recording of two frames."""
    tiny = synthetic_recording(cameras=3, held_out=1, frames=2, width=96, height=54)
    monkeypatch.setattr(demo, "synthetic_recording", lambda: tiny)


def test_a_demo_cut_off_while_it_writes_its_recording_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["demo", "--output", str(tmp_path / "demo"), "--iterations", "4"]
    write, written = folder_layout.write_png, []

    def cut_off(*arguments: object) -> None:
        if len(written) == 3:
            raise Stopped
        written.append(write(*arguments))  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(folder_layout, "write_png", cut_off)
        with pytest.raises(Stopped):
            main(command)
    assert len(written) == 3
    assert main(command) == 0
    out = capsys.readouterr().out
    assert all(f"| {name}" in out for name in demo.VARIANTS)
    assert (tmp_path / "demo" / "comparison.png").is_file()
    assert f"Player: {tmp_path / 'demo' / 'player.html'}" in out
    assert ReadPage(tmp_path / "demo" / "player.html").header["name"] == "recording"
    assert len(open_recording(tmp_path / "demo" / "recording").frames) == 2
    assert not list((tmp_path / "demo").glob("*unfinished*"))
