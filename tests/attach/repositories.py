"""Every repository that has an adapter, as its mimic: how it is made, drawn, edited and saved."""

import copy
from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import torch
from mimics import cem4dgs, deformable3d, ex4dgs, fastergs4d, fudan, gsplat, gsplat_dynamic, hust4d, spacetime, swift4d
from mimics.inria import default_options, kept
from tiny import make_views
from torch import Tensor

from d2_plugin.adapters.deformable3d import Deformable3DAdapter
from d2_plugin.adapters.ex4dgs import Ex4DGSAdapter
from d2_plugin.adapters.fudan import FudanAdapter
from d2_plugin.adapters.gsplat_dict import GsplatAdapter
from d2_plugin.adapters.hust4d import Hust4DAdapter
from d2_plugin.adapters.spacetime import SpacetimeAdapter
from d2_plugin.adapters.successors.cem4dgs import CEM4DGSAdapter
from d2_plugin.adapters.successors.fastergs4d import FasterGS4DAdapter
from d2_plugin.adapters.successors.gsplat_dynamic import GsplatDynamicAdapter
from d2_plugin.adapters.successors.swift4d import Swift4DAdapter
from d2_plugin.protocol import Backbone

MIMICS: dict[str, ModuleType] = {
    module.__name__.removeprefix("mimics."): module
    for module in (fudan, deformable3d, hust4d, spacetime, ex4dgs, gsplat, fastergs4d, gsplat_dynamic, swift4d, cem4dgs)
}


class Standing(NamedTuple):
    """A small model that stands still, and what the tests ask of it."""

    adapter: Backbone
    cameras: Sequence[object]
    model: Any
    draw: Callable[[object], Tensor]
    """A camera to the depth sum [H, W] of the mimic's own render."""
    optimizers: Callable[[], list[torch.optim.Optimizer]]
    tables: Callable[[], list[Tensor]]
    """One coordinate of every row, in the contract's order; views of the parameters."""
    edits: dict[str, Callable[[], object]]
    """The repository's own changes of rows; the first one grows."""
    evidence: Callable[[], Tensor] | None = None
    """A statistic of the repository's densification, one number a row, where the adapter does not name them."""


def jitter(*parameters: Tensor, by: float = 0.3) -> None:
    """Shapes and rotations that are not those of a start; large enough to be seen."""
    generator = torch.Generator().manual_seed(5)
    for parameter in parameters:
        parameter.data += by * torch.randn(parameter.shape, generator=generator)


SHAPES = ("_rotation", "_scaling", "_rotation_r", "_scaling_t", "_motion", "_omega", "_trbf_scale", "_xyz_disp")


@torch.no_grad()
def clone(model: Any) -> None:
    model.densify_and_clone((torch.arange(len(model._xyz)) % 3).float()[:, None], 1.5, 1e9)


@torch.no_grad()
def split(model: Any) -> None:
    model.densify_and_split((torch.arange(len(model._xyz)) % 4).float()[:, None], 2.5, 0.0)


@torch.no_grad()
def extract(model: Any) -> None:
    """Static rows of Ex4DGS that become dynamic."""
    model.xyz_error_min_timestamp.zero_()
    jitter(model._xyz_disp)
    model.extract_dynamic_points_from_static()


def inria(
    mimic: ModuleType, model: Any, make_adapter: Callable[[], Backbone], cameras: Sequence[object], **options: Any
) -> Standing:
    """A model of Inria's family; `options` are those of its render."""
    model.training_setup(default_options())
    jitter(*(getattr(model, name) for name in SHAPES if hasattr(model, name)))
    edits = {"clone": partial(clone, model), "split": partial(split, model)}
    two_tables = hasattr(model, "_xyz_motion")
    if two_tables:
        edits = {"clone": partial(clone, model), "extract": partial(extract, model)}
    moving = two_tables and not hasattr(model, "_parent")

    def draw(camera: object) -> Tensor:
        package = mimic.render(camera, model, [0, 0, 0], **options)
        return package.get("depth_sum", package["depth"])[0]

    def tables() -> list[Tensor]:
        if two_tables and not moving:  # cem-4dgs puts children at the origin of their motion
            return [model._features_dc.data[:, 0, 0]]
        return [model._xyz.data[:, 0], *([model._xyz_motion.data[:, 0, 0]] if moving else [])]

    return Standing(make_adapter(), cameras, model, draw, lambda: [model.optimizer], tables, edits)


def fudan_model(**attributes: object) -> tuple[Any, Any]:
    """Gaussians large enough to cover the images, and their scene; `attributes` are set on the model."""
    model, scene = fudan.make()
    model._scaling.data += 1.0
    vars(model).update(attributes)
    model.training_setup(default_options())
    return model, scene


def standing(mimic: ModuleType, make_adapter: Callable[[Any, Any], Backbone], **options: Any) -> Standing:
    """Of a mimic that is a model and a scene; `options` are those of its render."""
    model, scene = mimic.make()
    cameras = scene.train_cameras[1.0] if mimic is fudan else scene.cameras
    return inria(mimic, model, lambda: make_adapter(model, scene), cameras, **options)


def staged(mimic: ModuleType, adapter: Callable[..., Backbone], stage: str = "fine") -> Standing:
    return standing(mimic, lambda model, scene: adapter(model, scene, stage), stage=stage)


make_swift4d = partial(staged, swift4d, Swift4DAdapter)


def make_cem4dgs() -> Standing:
    made = standing(cem4dgs, lambda model, scene: CEM4DGSAdapter(model, near=0.2, far=100.0))
    with torch.no_grad():
        made.model.extract_dynamic_points_from_static(0.3)
    jitter(made.model._xyz_motion, made.model._rotation_motion)
    return made


def make_deformable3d(is_6dof: bool = False) -> Standing:
    model, deform, scene = deformable3d.make(is_6dof)
    made = inria(deformable3d, model, lambda: Deformable3DAdapter(model, deform, warm_up=0), scene.cameras)

    def draw(camera: Any) -> Tensor:
        motion = deform.step(model.get_xyz.detach(), camera.fid.expand(len(model.get_xyz), 1))
        return deformable3d.render(camera, model, [0, 0, 0], *motion, is_6dof)["depth"][0]

    return made._replace(draw=draw)


def make_fastergs4d() -> Standing:
    gaussians, views = fastergs4d.make()
    fastergs4d.Trainer(gaussians, views).setup_gaussians(None)
    jitter(gaussians._left_isoclinic_rotations, gaussians._right_isoclinic_rotations, gaussians._spatial_scales)

    @torch.no_grad()
    def grow() -> None:
        gaussians._densification_info = torch.stack([torch.ones(len(gaussians._opacities))] * 2)
        gaussians.adaptive_density_control(0.5, 0.005)
        gaussians.reset_densification_info()

    def draw(view: object) -> Tensor:
        return fastergs4d.render_image_training(gaussians, view)[1][2].depth_sum

    edits = {"grow": grow, "sort": torch.no_grad()(gaussians.apply_morton_ordering)}
    tables = lambda: [gaussians._spatial_means.data[:, 1]]  # noqa: E731  the first coordinate orders them
    adapter = FasterGS4DAdapter(gaussians, 0.5)
    evidence = lambda: gaussians._densification_info[1]  # noqa: E731
    return Standing(adapter, views, gaussians, draw, lambda: [gaussians.optimizer], tables, edits, evidence)


def gsplat_edits(params: Any, optimizers: Any, state: dict[str, Any]) -> dict[str, Callable[[], object]]:
    """The operations of gsplat.strategy.ops, on every fourth row; a split moves and shrinks its first child, too."""

    def every_fourth(operation: Callable[..., object]) -> None:
        operation(params, optimizers, state, torch.arange(len(params["means"])) % 4 == 0)

    operations = {name: getattr(gsplat, name) for name in ("duplicate", "split", "remove")}
    edits = {name: partial(every_fourth, operation) for name, operation in operations.items()}
    return edits | {"sample_add": lambda: gsplat.sample_add(params, optimizers, state, 3)}


def make_gsplat() -> Standing:
    splats, optimizers, strategy = gsplat.make()
    state = strategy.initialize_state() | {"grad2d": torch.zeros(60), "count": torch.zeros(60)}
    jitter(splats["quats"], splats["scales"])
    sum((p * 0).sum() for p in splats.values()).backward()
    for optimizer in optimizers.values():  # the strategy's operations expect moments
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    def draw(view: Any) -> Tensor:
        return gsplat.render(splats, view).depth_sum

    tables = lambda: [splats["quats"].data[:, 1]]  # noqa: E731
    made = GsplatAdapter(splats, optimizers, state), make_views(), splats, draw, lambda: list(optimizers.values())
    return Standing(*made, tables, gsplat_edits(splats, optimizers, state), lambda: state["grad2d"])


def make_gsplat_dynamic() -> Standing:
    params, optimizers, hexplane, net = gsplat_dynamic.make()
    state = gsplat_dynamic.DynamicStrategy().initialize_state(num_gaussians=60)
    state |= {"grad2d": torch.zeros(60), "count": torch.zeros(60)}
    jitter(params["quats"], params["scales"])
    adapter = GsplatDynamicAdapter(params, optimizers, state, hexplane, net, frames=2, camera="cam1")

    def draw(item: Any) -> Tensor:
        return gsplat_dynamic.rasterization(params, item, state, hexplane, net)[1]["depth_sum"]

    tables = lambda: [params["quats"].data[:, 1]]  # noqa: E731
    made = adapter, gsplat_dynamic.items(), params, draw, lambda: list(optimizers.values()), tables
    return Standing(*made, gsplat_edits(params, optimizers, state), lambda: state["grad2d"])


VARIANTS: dict[str, Callable[[], Standing]] = {
    "fudan": partial(standing, fudan, FudanAdapter),
    "spacetime": partial(standing, spacetime, lambda model, scene: SpacetimeAdapter(model, 2)),
    "ex4dgs": partial(standing, ex4dgs, lambda model, scene: Ex4DGSAdapter(model)),
    "hust4d": partial(staged, hust4d, Hust4DAdapter),
    "hust4d coarse": partial(staged, hust4d, Hust4DAdapter, "coarse"),
    "deformable3d": make_deformable3d,
    "deformable3d 6dof": partial(make_deformable3d, True),
    "gsplat": make_gsplat,
    "fastergs4d": make_fastergs4d,
    "gsplat_dynamic": make_gsplat_dynamic,
    "swift4d": make_swift4d,
    "cem4dgs": make_cem4dgs,
}
"""By the name of the adapter, and of the variant behind a space."""


def run(name: str, source: ModuleType | None = None, **options: Any) -> SimpleNamespace:
    """Train the mimic, or its attached `source`, from the same start."""
    return (source or MIMICS[name]).training(*MIMICS[name].make(), **options)


def snapshot(outcome: SimpleNamespace) -> dict[str, Tensor]:
    model = vars(outcome).get("gaussians", vars(outcome).get("splats", vars(outcome).get("params")))
    named = model.named_parameters() if isinstance(model, torch.nn.Module) else vars(model).items()
    return {key: value.detach().clone() for key, value in named if isinstance(value, torch.nn.Parameter)}


def saved(name: str, first: SimpleNamespace) -> object:
    """What a checkpoint has to hold for a run to go on; some repositories save less."""
    if name == "gsplat":
        return copy.deepcopy((first.splats, first.optimizers, first.strategy_state))
    if name == "gsplat_dynamic":
        nets = first.hexplane, first.deform_net, first.hex_optimizer
        return copy.deepcopy((first.params, first.optimizers, first.state, *nets))
    return (kept(first.gaussians), kept(first.deform)) if name == "deformable3d" else kept(first.gaussians)
