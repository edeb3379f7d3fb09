"""Small moving scenes for tests of exports, made from the bundled backbones without training them."""

import numpy as np
import torch
from tiny import make_adapter, make_model, make_views

from d2_plugin.backbones.model import SplatModel
from d2_plugin.backbones.yang4d import Yang4D, Yang4DSettings
from d2_plugin.protocol import View
from d2_plugin.recordings import Camera, Recording
from d2_plugin.viewing.export.scene import ExportScene, export_scene
from d2_plugin.viewing.viewed import KeptImages, ViewedRun

NASTY = '</script><script>alert(1)</script> & "tiny"'
WIDTH, HEIGHT = 160, 120
FRAMES = 12
DURATION = 0.5


def sharp_model(backbone: str, count: int = 400, **options: object) -> SplatModel:
    """Gaussians of a few pixels, of all shapes and colours, that move, before a background that differs by direction;
    `backbone` is one of `tiny.BACKBONES`."""
    generator = torch.Generator().manual_seed(1)
    model = make_model(count, backbone=backbone, **options)
    with torch.no_grad():
        rows = model.gaussians.parameters
        rows["log_scales"] += -1.4 + 0.7 * torch.randn(count, 3, generator=generator)
        rows["opacity_logits"] += 3 * torch.randn(count, generator=generator)
        for name in ("left", "right", "rotations"):
            if name in rows:
                # Turned a little in time, so that Gaussians move by parts of the scene and not beyond it.
                rows[name] += (0.05 if name == "right" else 0.3) * torch.randn(count, 4, generator=generator)
        if "right" in rows:
            rows["right"].copy_(rows["left"] + 0.05 * torch.randn(count, 4, generator=generator))
            rows["log_time_scales"] += 0.5 * torch.randn(count, generator=generator)
        if model.background is not None:
            model.background.constant.normal_(0, 0.2, generator=generator)
            model.background.harmonics.normal_(0, 0.2, generator=generator)
        if backbone == "deform":
            for plane in model.field.time:
                plane += 0.3 * torch.randn(plane.shape, generator=generator)
            model.field.heads.weight.normal_(0, 0.2, generator=generator)
    return model


def with_harmonics(count: int = 400, in_time: bool = False) -> SplatModel:
    """4D Gaussians whose colours differ by direction and, `in_time`, by time, before a sky."""
    plain, degree, generator = sharp_model("yang4d", count), 2 if in_time else 0, torch.Generator().manual_seed(3)
    rows = {name: value.detach() for name, value in plain.gaussians.parameters.items()}
    rows["harmonics"] = 0.2 * torch.randn(count, 16 * (degree + 1) - 1, 3, generator=generator)
    model = Yang4D(rows, Yang4DSettings(sh_degree=3, sh_time_degree=degree, background=in_time), 2.0, DURATION)
    if in_time:
        with torch.no_grad():
            model.background.harmonics.normal_(0, 0.2, generator=generator)
    return model


def larger(view: View) -> View:
    """The tiny view in images of 160 x 120, off centre so that the principal point matters."""
    intrinsics = view.K * torch.tensor([[WIDTH / view.width], [HEIGHT / view.height], [1.0]])
    intrinsics[:2, 2] += torch.tensor([5.0, -3.0])
    return View(view.camera, view.frame, view.time, view.T_camera_world, intrinsics, WIDTH, HEIGHT)


def make_scene(
    model: SplatModel, name: str = "tiny", cameras: tuple[str, ...] = ("left", "middle", "right")
) -> ExportScene:
    """The model seen by three cameras over a clip of twelve frames; the last camera is held out."""
    views = [larger(view) for view in make_views()[:3]]
    made = [
        Camera(name, WIDTH, HEIGHT, np.asarray(view.K.double()), np.asarray(view.T_camera_world.double()))
        for name, view in zip(cameras, views, strict=True)
    ]
    cameras = {camera.name: camera for camera in made}
    recording = Recording(
        "tiny" if name != NASTY else name, cameras, tuple(range(FRAMES)), (FRAMES - 1) / DURATION, KeptImages(cameras)
    )
    *train, held_out = cameras
    return export_scene(ViewedRun(name, recording, tuple(train), (held_out,), make_adapter(model)))


def rasterized(model: SplatModel, camera: int, time: float, finer: int = 1) -> dict[str, np.ndarray]:
    """What our rasterizer draws: color [H, W, 3] in 0..1, expected depth and alpha [H, W].

    Images have `finer` times as many pixels each way."""
    view = larger(make_views()[camera])
    K = view.K * torch.tensor([[finer], [finer], [1.0]])
    with torch.no_grad():
        render = model.render(View(view.camera, 0, time, view.T_camera_world, K, finer * WIDTH, finer * HEIGHT))
    depth = render.depth_sum / render.alpha.clamp(min=1e-4)
    return {"color": render.color.clamp(0, 1).numpy(), "depth": depth.numpy(), "opacity": render.alpha.numpy()}


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Of images in 0..1."""
    return float(-10 * np.log10(np.mean((np.asarray(a, float) - b) ** 2)))
