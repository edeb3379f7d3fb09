"""The launcher: somebody else's train.py with D2 attached and no line of it edited."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from mimics import fudan, hust4d
from mimics.inria import default_options
from mimics.page import attached
from mimics.workplace import HOOKS, furnish
from tiny import TinyStore

from d2_plugin import D2Config, D2Error, D2Hooks
from d2_plugin.adapters.hust4d import Hust4DAdapter
from d2_plugin.attach import launch
from d2_plugin.attach.launch import main
from d2_plugin.attach.packages import provide
from d2_plugin.attach.recipes import RECIPES, recipe
from d2_plugin.attach.session import Original, Session
from d2_plugin.config import DepthLossConfig

DEPTH_LOSS = D2Config(depth_loss=DepthLossConfig(start=2))
OPTIONS = default_options(iterations=12, densify_until_iter=0)


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the modules that fudan-zvg/4d-gaussian-splatting has, classes of its own for every test."""
    (tmp_path / "scene").mkdir()
    (tmp_path / "gaussian_renderer").mkdir()
    (tmp_path / "scene" / "__init__.py").write_text("from mimics import fudan\nclass Scene(fudan.Scene): pass\n")
    model = "from mimics import fudan\nclass GaussianModel(fudan.GaussianModel): pass\n"
    (tmp_path / "scene" / "gaussian_model.py").write_text(model)
    (tmp_path / "gaussian_renderer" / "__init__.py").write_text("from mimics.fudan import render\n")
    (tmp_path / "train.py").write_text(TRAIN)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in [name for name in sys.modules if name.split(".")[0] in ("scene", "gaussian_renderer")]:
        del sys.modules[name]


TRAIN = """
import sys
import torch
from gaussian_renderer import render
from scene import Scene
from scene.gaussian_model import GaussianModel
from mimics import fudan
from mimics.inria import cameras_of, default_options, initial_points

def evaluated_and_rendered(*arguments):
    with torch.no_grad():
        render(*arguments)
    return render(*arguments)

def trained():
    fudan.render = evaluated_and_rendered
    gaussians = GaussianModel()
    gaussians.create_from_pcd(*initial_points())
    scene = Scene(cameras_of(timestamp=lambda view: view.time))
    return fudan.training(gaussians, scene, default_options(iterations=12, densify_until_iter=0)).gaussians

if __name__ == "__main__":
    torch.save([p.detach() for p in trained()._xyz[None]], sys.argv[1])
"""


def run_wrapped(config: D2Config | None, monkeypatch: pytest.MonkeyPatch) -> tuple[torch.Tensor, Session | None]:
    """Positions after training the repository's script, with D2 wrapped around it or bare."""
    session = None
    monkeypatch.setattr(fudan, "render", fudan.render)  # put back after the test, since the script replaces it
    if config is not None:
        session = Session(recipe("fudan"), config, TinyStore())
        session.wrap()
    script: dict = {"__name__": "train"}
    exec(compile(TRAIN, "train.py", "exec"), script)
    return script["trained"]()._xyz.detach(), session


@pytest.mark.usefixtures("repository")
class TestSession:
    def test_without_hooks_it_is_bitwise_the_bare_trainer_and_with_them_the_loss_is_that_of_the_three_lines(
        self, repository: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The term is weighted like the trainer's own loss, which is divided by the size of the batch: of the renders
        with gradients, an evaluation beside each is not counted."""
        (bare, _), (without, _), (launched, _) = (run_wrapped(c, monkeypatch) for c in (None, D2Config(), DEPTH_LOSS))
        assert torch.equal(bare, without)
        furnish(repository, monkeypatch)
        (repository / "d2.toml").write_text(replace(DEPTH_LOSS, prior="prior").to_toml())
        three_lines = attached(fudan, "fudan").training(*fudan.make(), OPTIONS).gaussians._xyz.detach()
        assert (launched - bare).abs().max() > 1e-3
        torch.testing.assert_close(launched, three_lines, atol=2e-5, rtol=1e-4)

    def test_edits_happen_after_zero_grad_and_are_counted(self, monkeypatch: pytest.MonkeyPatch) -> None:
        positions, session = run_wrapped(HOOKS, monkeypatch)
        assert session.hooks.log.inserted > 0
        assert len(positions) == len(session.hooks.backbone)


def test_stages_of_4dgaussians_reach_the_adapter() -> None:
    """Its render is told the stage by name; the coarse one is left alone."""
    session = Session(recipe("hust4d"), DEPTH_LOSS, TinyStore())
    gaussians, scene = hust4d.make()
    session.objects.model, session.objects.scene = gaussians, scene
    session.hooks = D2Hooks(DEPTH_LOSS, Hust4DAdapter(gaussians, scene, "coarse"), TinyStore())
    drawn = {"render": gaussians._xyz.sum() * torch.ones(3, 2, 2)}
    session._rendering(lambda *_, stage: drawn, scene.getTrainCameras()[0], gaussians, stage="fine")
    assert session.hooks.backbone.stage == "fine"
    assert session.hooks.backbone.active(1)


def test_a_script_of_another_repository_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(D2Error, match="the script's folder has no scene.Scene .* give the repository that the script"):
        Session(recipe("fudan"), DEPTH_LOSS, TinyStore()).wrap()


STAND_IN = "d2_plugin.compat.nearest"


class TestOriginals:
    NAME = "a_module_built_in_cuda"

    @pytest.fixture(autouse=True)
    def _forgotten(self) -> Iterator[None]:
        yield
        for name in [name for name in sys.modules if name.split(".")[0] == self.NAME]:
            del sys.modules[name]

    def test_what_can_be_loaded_stays(self, tmp_path: Path) -> None:
        (tmp_path / "built.py").write_text("value = 1\n")
        provide((Original(self.NAME, STAND_IN, "built.py"),), tmp_path, on_cpu=False, replace_broken=False)
        assert sys.modules[self.NAME].value == 1

    def test_ours_takes_the_place_of_what_cannot_where_it_may_and_says_why(self, tmp_path: Path, caplog) -> None:
        (tmp_path / "built.py").write_text("raise RuntimeError('no nvcc')\n")
        wanted = Original(f"{self.NAME}.part", STAND_IN, "built.py")
        installed = Original(f"{self.NAME}._C", STAND_IN)
        absent = Original(f"{self.NAME}.absent", STAND_IN, "absent.py")
        provide((wanted, installed, absent), tmp_path, on_cpu=False, replace_broken=True)
        assert sys.modules[f"{self.NAME}.part"].distCUDA2(torch.rand(0, 3)).shape == (0,)
        exec(f"from {self.NAME}._C import distCUDA2")
        assert "d2_plugin.compat.nearest stands in for it (its import failed: no nvcc)" in caplog.text
        assert "(no file absent.py)" in caplog.text

    def test_on_a_gpu_nothing_is_replaced_unasked(self, tmp_path: Path) -> None:
        with pytest.raises(D2Error, match=r"cannot be loaded \(no file built.py\): build it .* or give --stand-ins"):
            provide((Original(self.NAME, STAND_IN, "built.py"),), tmp_path, on_cpu=False, replace_broken=False)

    @pytest.mark.parametrize(("built", "works"), [("object()", True), ("None", False)])
    def test_gsplat_is_what_its_own_loader_loads_or_builds(self, tmp_path, monkeypatch, built, works) -> None:
        """As PyPI ships it, it builds its kernels at first use and never has `gsplat.csrc`."""
        for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
            monkeypatch.delitem(sys.modules, name)
        (tmp_path / "gsplat" / "cuda").mkdir(parents=True)
        for folder in ("gsplat", "gsplat/cuda"):
            (tmp_path / folder / "__init__.py").touch()
        (tmp_path / "gsplat" / "cuda" / "_backend.py").write_text(f"_C = {built}\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        provide(RECIPES["gsplat"].originals, tmp_path, on_cpu=False, replace_broken=True)
        assert ("gsplat.csrc" in sys.modules) == (not works)
        for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
            del sys.modules[name]


class TestCommand:
    def test_an_unedited_script_trains_on_the_cpu_and_is_refused_a_restart(self, repository: Path) -> None:
        """It says device="cuda" as they all do; here a line before the training of the mimic, and one after it."""
        asked = 'import no_dynamo, torch\nassert torch.zeros(1, device="cuda").cuda().device.type == "cpu"\n'
        restart = "    import os\n    os.execv(sys.executable, ['python', 'train.py'])\n"
        (repository / "train.py").write_text(asked + TRAIN + restart)
        tests = f"{Path(__file__).parents[1]}"
        environment = os.environ | {"CUDA_VISIBLE_DEVICES": "", "PYTHONPATH": tests, "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "d2_plugin.attach", "fudan", "--cpu", "--", "train.py", "out.pt"]
        done = subprocess.run(command, cwd=repository, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 2, done.stderr
        assert "d2_plugin.compat.fourd stands in for it (it needs a GPU)" in done.stderr
        assert "device 'cuda' means 'cpu'" in done.stderr
        assert (repository / "out.pt").is_file()
        assert "d2: the trainer wants to restart itself as python train.py" in done.stderr

    def test_mistakes_are_one_sentence(self, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
        assert main(["fudan", "--d2", "d2.toml"]) == 2
        assert "put the repository's train.py and its arguments after --" in capsys.readouterr().err
        assert main(["fudan", "--", str(tmp_path / "train.py")]) == 2
        assert "no script at" in capsys.readouterr().err

    @pytest.mark.parametrize(("code", "ends"), [("0", [True]), ("None", [True]), ("3", [])])
    def test_a_script_that_exits_is_ended_like_any_other(self, tmp_path: Path, monkeypatch, code, ends) -> None:
        ended: list[bool] = []
        monkeypatch.setattr(launch, "prepare", lambda *_: SimpleNamespace(end=lambda: ended.append(True)))
        (tmp_path / "train.py").write_text(f"import sys\nsys.exit({code})")
        with nullcontext() if ends else pytest.raises(SystemExit):
            assert main(["fudan", "--", str(tmp_path / "train.py")]) == 0
        assert ended == ends

    def test_a_script_may_go_to_another_folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        options, _ = launch.parsed(["fudan", "--d2", "d2.toml", "--exported", "data", "--", "train.py"])
        assert (options.d2, options.exported) == (tmp_path / "d2.toml", tmp_path / "data")

    def test_without_a_gpu_the_cpu_has_to_be_asked_for(self, tmp_path: Path, monkeypatch, capsys) -> None:
        monkeypatch.setattr(launch.torch.cuda, "is_available", lambda: False)
        (tmp_path / "train.py").touch()
        assert main(["fudan", "--", str(tmp_path / "train.py")]) == 2
        assert "add --cpu to try it on the CPU" in capsys.readouterr().err
