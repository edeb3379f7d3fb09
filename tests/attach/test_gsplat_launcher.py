"""gsplat's simple_trainer through the launcher: its modules in small, a stand-in to draw, cameras told by pose."""

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from mimics import gsplat
from mimics.workplace import HOOKS
from refusals import refuses
from splat_scenes import random_scene
from tiny import TinyStore, make_views

from d2_plugin import D2Config
from d2_plugin.adapters.gsplat_dict import GsplatAdapter
from d2_plugin.adapters.keys import ViewsByPose
from d2_plugin.attach.gsplat import GsplatSession, put_in_place
from d2_plugin.attach.recipes import recipe
from d2_plugin.compat import gsplat as stand_in
from d2_plugin.protocol import RasterSettings
from d2_plugin.rasterizer import reference
from d2_plugin.recordings.export.colmap import test_every as every_nth

FILES = {
    "gsplat/__init__.py": "from .rendering import rasterization\n",
    "gsplat/csrc.py": "",
    "gsplat/rendering.py": "def rasterization(*_, **__):\n    raise AssertionError('this needs a GPU')\n",
    "gsplat/strategy.py": "from mimics.gsplat import DefaultStrategy as Kept\n"
    "class DefaultStrategy(Kept): pass\nclass MCMCStrategy(Kept): pass\n",
    "gsplat/distributed.py": "def cli(main, settings, verbose=False):\n    raise AssertionError('CUDA is required')\n",
    "torchmetrics/image/lpip.py": "class LearnedPerceptualImagePatchSimilarity: pass\n",
    "datasets/colmap.py": """
import torch
from tiny import make_views

class Parser:
    def __init__(self, data_dir="data"):
        self.data_dir = data_dir
        views = make_views()[:3]
        self.camtoworlds = torch.stack([torch.linalg.inv(v.T_camera_world) for v in views]).double().numpy()
        self.image_names = [f"{v.camera}_{v.frame:04d}.png" for v in views]
""",
    "simple_trainer.py": """
import torch
from datasets.colmap import Parser
from gsplat.distributed import cli
from gsplat.rendering import rasterization
from gsplat.strategy import DefaultStrategy
from mimics import gsplat as mimic
from tiny import TinyFrames
from types import SimpleNamespace

class Runner:
    def __init__(self, rank, world_rank, world_size, settings):
        self.parser, self.settings, self.frames = Parser(), settings, TinyFrames()
        self.splats, self.optimizers, _ = mimic.make()
        self.strategy = DefaultStrategy()
        self.strategy.check_sanity(self.splats, self.optimizers)
        self.strategy_state = self.strategy.initialize_state(scene_scale=2.0)
    def train(self):
        for step in range(self.settings.max_steps):
            index = step % 3
            view, p = self.frames.views[index], self.splats
            colors, alphas, info = rasterization(
                means=p["means"], quats=p["quats"], scales=p["scales"].exp(), opacities=torch.sigmoid(p["opacities"]),
                colors=torch.cat([p["sh0"], p["shN"]], 1), viewmats=view.T_camera_world[None], Ks=view.K[None],
                width=view.width, height=view.height, sh_degree=1, packed=False,
                near_plane=0.02, rasterize_mode="antialiased")
            info["means2d"].retain_grad()
            (colors[0] - self.frames.image(index)).abs().mean().backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            seen = SimpleNamespace(offsets=SimpleNamespace(grad=info["means2d"].grad[0]))
            self.strategy.step_post_backward(self.splats, self.optimizers, self.strategy_state, step, seen)

def main(local_rank, world_rank, world_size, settings):
    global runner
    runner = Runner(local_rank, world_rank, world_size, settings)
    runner.train()

def start():
    cli(main, SimpleNamespace(max_steps=40))
    return runner
""",
}


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """gsplat's modules in small, with a renderer and a launcher that fail as they do without a GPU."""
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    tops = {"gsplat", "torchmetrics", "datasets", "simple_trainer"}
    for name in [name for name in sys.modules if name.split(".")[0] in tops]:
        monkeypatch.delitem(sys.modules, name)
    importlib.invalidate_caches()
    sys.modules["gsplat.csrc"] = stand_in
    yield tmp_path
    for name in [name for name in sys.modules if name.split(".")[0] in tops]:
        del sys.modules[name]


def trained(config: D2Config | None) -> tuple[dict[str, torch.Tensor], GsplatSession | None]:
    """Parameters after the script, and what followed it."""
    torch.manual_seed(0)
    put_in_place()
    session = None
    if config is not None:
        session = GsplatSession(recipe("gsplat"), config, TinyStore())
        session.wrap()
    runner = importlib.import_module("simple_trainer").start()
    return {name: value.detach() for name, value in runner.splats.items()}, session


@pytest.mark.usefixtures("checkout")
def test_without_hooks_the_script_ends_with_the_same_bits() -> None:
    bare, _ = trained(None)
    del sys.modules["simple_trainer"]
    off, _ = trained(D2Config())
    assert all(torch.equal(bare[name], off[name]) for name in bare)


@pytest.mark.usefixtures("checkout")
def test_hooks_insert_remove_and_pull_on_depth_and_the_scripts_own_growth_is_said_once(caplog) -> None:
    attached, session = trained(HOOKS)
    assert session.hooks.log.inserted > 0
    assert len(attached["means"]) == len(session.hooks.backbone)
    assert session.hooks.backbone.settings == RasterSettings(near=0.02, antialiased=True)
    image = torch.zeros(1, requires_grad=True)
    refuses("pinhole cameras alone, got .*'fisheye'", session._drawing, lambda **_: [image], camera_model="fisheye")
    assert {entry.hook for entry in session.hooks.trace} == {"densify", "prune", "depth_loss"}
    said = re.findall(r"the trainer's own densification has made (\d+) Gaussians beside the (\d+)", caplog.text)
    assert len(said) == 1, caplog.text
    assert int(said[0][0]) > int(said[0][1]) > 0


@pytest.mark.usefixtures("checkout")
def test_the_export_that_the_parser_reads_renames_the_cameras(tmp_path: Path, monkeypatch) -> None:
    """As a run of the real script showed: its images are called cam05 where the prior says 01."""
    from d2_plugin.store import exported

    read: list[Path] = []
    monkeypatch.setattr(exported, "export_read", lambda prior, source: read.append(source))
    session = GsplatSession(recipe("gsplat"), D2Config(prior="prior"))
    session.objects.scene = SimpleNamespace(data_dir=str(tmp_path))
    assert session._configured(40, int) == D2Config(prior="prior")
    assert read == [tmp_path]


@pytest.mark.usefixtures("checkout")
def test_several_gpus_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    refuses("train on 2 GPUs, and D2 follows one: set CUDA_VISIBLE_DEVICES=0", trained, None)


class TestViewsByPose:
    PARSER = SimpleNamespace(
        camtoworlds=np.stack([np.linalg.inv(v.T_camera_world.double().numpy()) for v in make_views()[:3]]),
        image_names=[f"{v.camera}_{v.frame:04d}.png" for v in make_views()[:3]],
    )

    def test_an_item_of_the_data_set_is_told_by_its_pose(self) -> None:
        adapter = GsplatAdapter(*gsplat.make()[:2], {}, parser=self.PARSER)
        for view in make_views()[:3]:
            item = {"camtoworld": torch.linalg.inv(view.T_camera_world)[None], "K": view.K[None]}
            found = adapter.view(item | {"image": torch.zeros(1, 24, 32, 3)})
            assert (found.camera, found.frame, found.width, found.height) == (view.camera, view.frame, 32, 24)
            torch.testing.assert_close(found.T_camera_world, view.T_camera_world)

    def test_a_pose_of_two_images_or_of_none_is_refused(self) -> None:
        view = make_views()[0]
        item = {"camtoworld": torch.linalg.inv(view.T_camera_world), "K": view.K, "width": 32, "height": 24}
        poses = np.repeat(self.PARSER.camtoworlds[:1], 2, 0)
        twice = SimpleNamespace(camtoworlds=poses, image_names=["cam0_0000.png", "cam0_0001.png"])
        refuses("2 images have the pose of this view", ViewsByPose(twice), item)
        item["camtoworld"] = item["camtoworld"] + 0.5
        refuses("0 images have the pose of this view", ViewsByPose(self.PARSER), item)


class TestRasterization:
    @pytest.fixture
    def given(self) -> tuple[dict, object]:
        scene = random_scene(3, 40, 24, 16)
        generator = torch.Generator().manual_seed(2)
        quats = torch.randn(40, 4, generator=generator)
        scales = 0.02 + 0.2 * torch.rand(40, 3, generator=generator)
        view = scene.view
        named = {"means": scene.means.float(), "quats": quats, "scales": scales, "opacities": scene.opacities.float()}
        named |= {"viewmats": view.T_camera_world.float()[None], "Ks": view.K.float()[None]}
        named["colors"] = scene.colors.float()
        return named | {"width": view.width, "height": view.height, "near_plane": 0.01}, view

    def test_it_draws_what_the_reference_draws(self, given: tuple[dict, object]) -> None:
        named, view = given
        image, alpha, meta = stand_in.rasterization(**named, render_mode="RGB+D", packed=False)
        small = float(meta["radii"].float().median())
        clipped, _, meta = stand_in.rasterization(**named, packed=False, radius_clip=small)
        assert meta["radii"][meta["radii"] > 0].min() > small
        alone = {k: v[meta["radii"][0, :, 0] > 0] for k, v in named.items() if torch.is_tensor(v) and len(v) == 40}
        torch.testing.assert_close(clipped, stand_in.rasterization(**named | alone)[0])
        raw = {"means": named["means"], "quats": named["quats"], "scales": named["scales"].log()}
        splats = GsplatAdapter(raw | {"opacities": torch.logit(named["opacities"])}, {}).slice_at(view)
        expected = reference.rasterize(splats, named["colors"], view, RasterSettings(near=0.01))
        torch.testing.assert_close(image[0, ..., :3], expected.color, atol=2e-5, rtol=1e-4)
        torch.testing.assert_close(image[0, ..., 3], expected.depth_sum, atol=2e-4, rtol=1e-4)
        torch.testing.assert_close(alpha[0, ..., 0], expected.alpha, atol=2e-5, rtol=1e-4)
        assert expected.alpha.max() > 0.5

    def test_centres_get_the_gradient_in_pixels_packed_or_not(self, given: tuple[dict, object]) -> None:
        named, view = given
        target = torch.rand(1, view.height, view.width, 3, generator=torch.Generator().manual_seed(5))
        found = []
        for packed in (False, True):
            image, _, meta = stand_in.rasterization(**named, packed=packed)
            meta["means2d"].retain_grad()
            (image - target).square().sum().backward()
            found.append(meta)
        dense, sparse = found
        assert dense["means2d"].grad.abs().max() > 0
        torch.testing.assert_close(dense["means2d"].grad[0, sparse["gaussian_ids"]], sparse["means2d"].grad)
        assert torch.equal(dense["radii"][0, sparse["gaussian_ids"]], sparse["radii"])
        homogeneous = torch.cat([named["means"], torch.ones(40, 1)], 1) @ view.T_camera_world.float().T
        pixels = (homogeneous[:, :3] @ view.K.float().T)[:, :2] / homogeneous[:, 2:3]
        torch.testing.assert_close(dense["means2d"][0].detach(), pixels, atol=1e-3, rtol=1e-4)

    def test_what_needs_its_kernels_is_refused_by_name(self, given: tuple[dict, object]) -> None:
        refuses("absgrad of gsplat's .* needs its own kernels", stand_in.rasterization, **given[0], absgrad=True)
        refuses("render_mode 'RGB-Ed'", stand_in.rasterization, **given[0], render_mode="RGB-Ed")
        refuses("camera_model 'fisheye'", stand_in.rasterization, **given[0], camera_model="fisheye")


@pytest.mark.parametrize(("trained_on", "held_out", "every"), [(4, 1, 5), (4, 4, 2), (7, 1, 8), (8, 2, 9), (6, 3, 4)])
def test_every_nth_image_is_held_out(trained_on: int, held_out: int, every: int) -> None:
    assert every_nth(trained_on, held_out) == every
    assert len([i for i in range(trained_on + held_out) if i % every == 0]) == held_out


def test_a_number_of_cameras_that_the_parser_cannot_hold_out_is_refused() -> None:
    refuses(r"no N gives 4 of 6", every_nth, 2, 4)
    refuses(r"no N gives 0 of 4", every_nth, 4, 0)
