"""What the launcher knows of each repository, in one place: names of modules, and how its adapter is made."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from d2_plugin.attach.gsplat import GsplatSession, put_in_place
from d2_plugin.attach.repairs import saves_parents
from d2_plugin.attach.session import Adapter, Objects, Original, Recipe
from d2_plugin.errors import refuse_unknown
from d2_plugin.protocol import Backbone


def _fudan(adapter: Adapter, objects: Objects) -> Backbone:
    return adapter(objects.model, objects.scene)


def _deformable3d(adapter: Adapter, objects: Objects) -> Backbone:
    arguments, _ = objects.given.get("scene", ((None,), {}))
    exact = bool(getattr(arguments[0], "is_blender", False))
    return adapter(objects.model, objects.deform, warm_up=objects.options.warm_up, exact_times=exact)


def _enter_stage(adapter: Any, named: Mapping[str, Any]) -> None:
    if "stage" in named:
        adapter.enter_stage(named["stage"])


def _spacetime(adapter: Adapter, objects: Objects) -> Backbone:
    """Its Scene gets the number of frames, and N of the folder colmap_N is the first of them."""
    (dataset, *_), named = objects.given["scene"]
    first = Path(dataset.source_path).name.split("_")[1:2]
    number = int(first[0]) if first and first[0].isdigit() else 0
    return adapter(objects.model, int(named["duration"]), first_frame=number)


def _ex4dgs(adapter: Adapter, objects: Objects) -> Backbone:
    dataset = objects.given["scene"][0][0]
    return adapter(objects.model, near=dataset.near, far=dataset.far)


_KNN = Original("simple_knn._C", "d2_plugin.compat.nearest")
_SPLATTING = "thirdparty.gaussian_splatting"
_STG_RASTERIZERS = tuple(
    Original(f"diff_gaussian_rasterization_{kind}", "d2_plugin.compat.spacetime") for kind in ("ch3", "ch9")
)

RECIPES = {
    "fudan": Recipe(
        "fudan",
        _fudan,
        (
            Original(
                "gaussian_renderer.diff_gaussian_rasterization",
                "d2_plugin.compat.fourd",
                "gaussian_renderer/diff_gaussian_rasterization.py",
            ),
            _KNN,
        ),
    ),
    "4c4d": Recipe(
        "fudan",
        _fudan,
        (
            Original("diff_gaussian_rasterization", "d2_plugin.compat.fourd"),
            _KNN,
            Original("fused_ssim", "d2_plugin.compat.vision"),
        ),
    ),
    "deformable3d": Recipe(
        "deformable3d",
        _deformable3d,
        (Original("diff_gaussian_rasterization", "d2_plugin.compat.depth"), _KNN),
        seen={"scene": ("scene", "Scene"), "deform": ("scene.deform_model", "DeformModel")},
    ),
    "hust4d": Recipe(
        "hust4d",
        lambda adapter, objects: adapter(objects.model, objects.scene, "coarse"),  # see `_enter_stage`
        (Original("diff_gaussian_rasterization", "d2_plugin.compat.depth"), _KNN),
        before_loss=_enter_stage,
    ),
    "spacetime": Recipe(
        "spacetime",
        _spacetime,
        (*_STG_RASTERIZERS, _KNN),
        models=tuple((f"{_SPLATTING}.scene.{kind}", "GaussianModel") for kind in ("oursfull", "ourslite")),
        renderers=tuple((f"{_SPLATTING}.renderer", f"train_{kind}") for kind in ("ours_full", "ours_lite")),
        seen={"scene": (f"{_SPLATTING}.scene", "Scene")},
        folders=("thirdparty/gaussian_splatting",),
        averages_gradients=True,
    ),
    "ex4dgs": Recipe(
        "ex4dgs",
        _ex4dgs,
        (Original("diff_gaussian_rasterization_df", "d2_plugin.compat.ex4dgs"), _KNN),
        models=(("scene.c_gaussian_model", "CGaussianModel"),),
    ),
    "cem4dgs": Recipe(
        "cem4dgs",
        _ex4dgs,
        (
            Original("diff_gaussian_rasterization_df", "d2_plugin.compat.ex4dgs"),
            Original("lpipsPyTorch", "d2_plugin.compat.vision", "lpipsPyTorch/__init__.py"),
            _KNN,
        ),
        models=(("scene.v_gaussian_model", "VGaussianModel"),),
        prepare=saves_parents,
    ),
    "gsplat": Recipe(
        "gsplat",
        lambda adapter, made: adapter(*made.model, made.state, parser=made.scene, scene=made.gaussians),
        (Original("gsplat.csrc", "d2_plugin.compat.gsplat", loader=("gsplat.cuda._backend", "_C")),),
        models=(),
        renderers=(),
        session=GsplatSession,
        prepare=put_in_place,
        script="examples/simple_trainer.py",
        folders=("..",),
        seen={"scene": ("datasets.colmap", "Parser")},
    ),
}


def recipe(name: str) -> Recipe:
    """The recipe of that name; an unknown name is refused, with the known ones."""
    refuse_unknown("repository", [name], RECIPES)
    return RECIPES[name]
