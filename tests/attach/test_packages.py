"""What a trainer imports and this environment lacks: found in its files, stood in for in memory, or asked for."""

import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from refusals import refuses

from d2_plugin.attach import cpu, repairs
from d2_plugin.attach.packages import STAND_INS, StandIn, missing, needed, needs, stand_in_for
from d2_plugin.attach.recipes import recipe


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository in small, as SpacetimeGaussians lays it out: a folder that its script puts on the path."""
    inner = tmp_path / "thirdparty" / "splatting"
    (inner / "scene").mkdir(parents=True)
    (inner / "scene" / "__init__.py").write_text("from utils.tools import thing\nimport absent_one.part as p\n")
    (inner / "utils").mkdir()
    (inner / "utils" / "tools.py").write_text("import numpy, os.path\nfrom absent_two import *\nfrom ._C import x\n")
    waiting = "def later():\n    import absent_inside\ntry:\n    import absent_tried\nexcept ImportError:\n    pass\n"
    (tmp_path / "train.py").write_text(f"import torch\nfrom thirdparty.splatting.scene import Scene\n{waiting}")
    before = list(sys.meta_path)
    yield tmp_path / "train.py"
    sys.meta_path[:] = before
    for name in [name for name in sys.modules if name.startswith("absent_")]:
        del sys.modules[name]


def test_what_a_script_needs_is_read_from_the_files_it_reaches(script: Path) -> None:
    packages = needed(script)
    assert set(packages) == {"torch", "numpy", "absent_one", "absent_two"}  # what lies beside a file is no package
    assert packages["absent_two"] == "thirdparty/splatting/utils/tools.py:2"
    assert set(missing(script, {"absent_one.part"})) == {"absent_two"}


def test_of_the_standard_library_what_servers_lack_is_looked_for(script: Path) -> None:
    """4DGaussians has `from tkinter import W`, which nothing uses; Debian's and Ubuntu's Python come without it."""
    script.write_text("import json\nfrom tkinter import W\n")
    assert set(needed(script)) == {"tkinter"}
    assert "tkinter" in STAND_INS


def test_what_an_option_imports_is_stood_in_for_but_not_asked_for(script: Path, monkeypatch) -> None:
    """gsplat's script imports torch_dgx for `--backend dgx`, 4DGaussians' mmcv for `--configs`."""
    option = "    if torch.option == 'dgx':\n        import absent_four\n"
    script.write_text(f"import torch\nif __name__ == '__main__':\n    import absent_three\n{option}")
    assert set(needed(script)) == {"torch", "absent_three", "absent_four"}
    assert set(needed(script, conditional=False)) == {"torch", "absent_three"}
    refuses("run `pip install absent_three`", stand_in_for, script, set())
    assert needs(recipe("fudan"), script).splitlines()[-1] == "install what is missing: `pip install absent_three`"
    monkeypatch.setitem(STAND_INS, "absent_four", StandIn({}, "it is made up"))
    monkeypatch.setitem(STAND_INS, "absent_three", StandIn({}, "it is made up"))
    stand_in_for(script, set())
    import absent_four

    class Derived(absent_four.Viewer):
        """As gsplat's script derives its viewer from nerfview's."""

    assert Derived.__mro__[1:] == (object,)


def test_what_nothing_stands_in_for_is_one_sentence_with_the_command(script: Path) -> None:
    sentence = r"absent_one \(thirdparty.*:2\), absent_two .*run `pip install absent_one absent_two`"
    refuses(sentence, stand_in_for, script, set())


def test_ours_takes_the_place_and_the_rest_says_so_when_it_is_called(script: Path, monkeypatch, caplog) -> None:
    monkeypatch.setitem(STAND_INS, "absent_one", StandIn({"absent_one.part.clamp": "torch:clamp"}, "it is made up"))
    monkeypatch.setitem(STAND_INS, "absent_two", StandIn({}, "it is made up"))
    stand_in_for(script, set())
    assert "absent_one is missing: D2 stands in for what training calls of it (it is made up)" in caplog.text
    import absent_one
    from absent_one.part import clamp
    from absent_two.deeper import Anything

    assert clamp is torch.clamp
    assert absent_one.part.clamp is torch.clamp
    refuses("the trainer calls absent_two.deeper.Anything, and absent_two is missing", Anything, 1)


def test_what_newer_libraries_dropped_is_restored(monkeypatch) -> None:
    """Names of numpy 1, signed bytes as images (fudan), processes of joblib as threads (cem-4dgs), numbers in JSON."""
    image, joblib = pytest.importorskip("PIL.Image"), pytest.importorskip("joblib")
    monkeypatch.setattr(image, "fromarray", image.fromarray)
    monkeypatch.setattr(joblib.parallel, "BACKENDS", dict(joblib.parallel.BACKENDS))
    monkeypatch.setattr(json.JSONEncoder, "default", json.JSONEncoder.default)
    for name in repairs.NUMPY_NAMES.keys() & vars(np).keys():
        monkeypatch.delattr(np, name)
    repairs.repair()
    assert np.NaN is np.nan
    values = np.array([[[0, 127, 255]]], np.uint8)
    assert np.array_equal(np.array(image.fromarray(values.view(np.int8), "RGB")), values)
    here = joblib.Parallel(n_jobs=2, backend="loky")(joblib.delayed(os.getpid)() for _ in range(2))
    assert set(here) == {os.getpid()}
    assert json.dumps({"SSIM": np.float32(0.5)}) == '{"SSIM": 0.5}'
    with pytest.raises(TypeError, match="not JSON serializable"):
        json.dumps(object())


def test_no_parent_is_saved_as_numpy_1_wrote_it(monkeypatch) -> None:
    class Model:
        def __init__(self) -> None:
            self._parent = torch.tensor([[-1], [3]])
            self.saved: list[tuple[int, ...]] = []

        def save_ply(self, path: str) -> None:
            table = np.empty(2, dtype=[("parent", "u4")])
            table[:] = list(map(tuple, self._parent.numpy()))
            self.saved = table.tolist()

    monkeypatch.setitem(sys.modules, "scene.v_gaussian_model", SimpleNamespace(VGaussianModel=Model))
    repairs.saves_parents()
    model = Model()
    model.save_ply("point_cloud.ply")
    assert model.saved == [(2**32 - 1,), (3,)]
    assert model._parent.tolist() == [[-1], [3]]


def test_the_number_of_a_gpu_is_the_cpu_too() -> None:
    """Ex4DGS says torch.device(0) in safe_state; torch refuses that where there is no GPU."""
    with cpu.CudaMeansCpu():
        assert torch.device(0).type == "cpu"
        assert torch.zeros(2, device=0).device.type == "cpu"
        assert torch.zeros(2, device="cuda").device.type == "cpu"


def test_the_doctor_lists_what_a_trainer_lacks(script: Path, monkeypatch) -> None:
    monkeypatch.setitem(STAND_INS, "absent_two", StandIn({}, "it is made up"))
    report = needs(recipe("fudan"), script.parent)
    assert "absent_one" in report
    assert "run `pip install absent_one`" in report
    assert "the launcher stands in for it; it is made up" in report
    assert "d2_plugin.compat.nearest" in report
    assert report.splitlines()[-1] == "install what is missing: `pip install absent_one`"
    refuses("no train.py in .* give the folder of the repository", needs, recipe("fudan"), script.parent / "thirdparty")


def test_a_script_that_is_no_python_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "train.py"
    path.write_text("root:x:0:0:root:/root:/bin/bash")
    refuses(r"cannot read .*train\.py as Python of this version .* give the trainer's", needs, recipe("fudan"), path)
