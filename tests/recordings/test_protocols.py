"""Published camera splits by name: the lists are those of the source, and a list that is not public is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stand_in_recordings import smooth_recording

from d2_plugin.commands.cli import main
from d2_plugin.errors import D2Error
from d2_plugin.recordings import Recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.presets import resolve_cameras, split_name
from d2_plugin.recordings.protocols import OURS, PROTOCOLS, protocol_split

ALL = tuple(f"cam{i:02d}" for i in range(21))


def rig(name: str = "sear_steak", cameras: tuple[str, ...] = ALL) -> Recording:
    return replace(smooth_recording(cameras, frames=1, width=32, height=24), name=name)


class TestPublished:
    def test_gc_4dgs_counts_the_sorted_cameras_of_each_scene(self) -> None:
        assert protocol_split(rig(), "protocol:gc-4dgs-4").train == ("cam04", "cam09", "cam12", "cam17")
        assert protocol_split(rig("flame_salmon_1"), "protocol:gc-4dgs-3").train == ("cam05", "cam09", "cam14")
        beef = rig("cut_roasted_beef", tuple(name for name in ALL if name != "cam03"))
        assert protocol_split(beef, "protocol:gc-4dgs-2").train == ("cam07", "cam15")  # places 6 and 14, not names

    def test_gc_4dgs_scores_the_first_camera_and_4c4d_all_others(self) -> None:
        assert protocol_split(rig(), "protocol:gc-4dgs-2").test == ("cam00",)
        split = protocol_split(rig(), "protocol:4c4d")
        assert split.train == ("cam01", "cam10", "cam13", "cam20")
        assert set(split.test) == set(ALL) - set(split.train)

    @pytest.mark.parametrize("name", PROTOCOLS)
    def test_each_says_its_source_and_never_trains_on_what_it_scores(self, name: str) -> None:
        split = protocol_split(rig(), f"protocol:{name}")
        assert not set(split.train) & set(split.test)
        assert PROTOCOLS[name][0] in split.notes[0]


class TestRefused:
    def test_the_papers_own_lists_are_not_public(self) -> None:
        with pytest.raises(D2Error, match="not public.*protocol:ours-4"):
            protocol_split(rig(), "protocol:d2-4dgs-4")

    def test_a_part_of_a_rig_whose_places_would_mean_other_cameras(self) -> None:
        with pytest.raises(D2Error, match="whole recording"):
            protocol_split(rig(cameras=ALL[:5]), "protocol:gc-4dgs-4")
        with pytest.raises(D2Error, match="no cam13, cam20"):
            protocol_split(rig(cameras=ALL[:12]), "protocol:4c4d")

    def test_a_recording_that_the_protocol_is_not_about_and_a_name_with_a_typo(self) -> None:
        with pytest.raises(D2Error, match="not for 'den'"):
            protocol_split(rig("den"), "protocol:gc-4dgs-3")
        with pytest.raises(D2Error, match="did you mean"):
            protocol_split(rig(), "protocol:gc-4dgs4")


def test_ours_are_the_presets(tmp_path: Path) -> None:
    path = save_recording(rig(), tmp_path / "sear_steak")
    for name in OURS:
        assert resolve_cameras(path, (f"protocol:{name}",))[:2] == resolve_cameras(path, (f"preset:{name[-1]}",))[:2]


def test_the_name_of_a_split_is_known_and_camera_names_have_none() -> None:
    assert split_name(("protocol:4c4d",)) == "protocol:4c4d"
    assert split_name(("preset:4",)) == "preset:4"
    assert split_name(("00", "02")) is None


def test_results_carry_the_protocols_name(tmp_path: Path) -> None:
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    path = save_recording(rig(), tmp_path / "sear_steak")
    command = ["train", str(path), "--train-cameras", "protocol:4c4d", "--test-cameras", "cam00", "--hooks", "none"]
    assert main([*command, "--iterations", "1", "--output", str(tmp_path / "run")]) == 0
    assert '"protocol": "protocol:4c4d"' in (tmp_path / "run" / "metrics.json").read_text()
    from d2_plugin.runs.report.run_folders import training_rows

    (row,) = training_rows([tmp_path / "run"])
    assert row["protocol"] == "protocol:4c4d"
    assert row["case"] == "sear_steak, 4 views, protocol:4c4d"
    assert np.isfinite(row["scores"]["psnr"])
