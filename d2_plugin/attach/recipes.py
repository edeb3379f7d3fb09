"""What the launcher must know of each repository: names of modules, and how its adapter is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from d2_plugin import registry
from d2_plugin.errors import unknown_name
from d2_plugin.protocol import Backbone

Adapter = Callable[..., Backbone]


@dataclass
class Objects:
    """The trainer's own objects, as they come into being."""

    model: Any = None
    options: Any = None
    """What `training_setup` was given: the optimization parameters."""
    scene: Any = None
    deform: Any = None


@dataclass(frozen=True)
class Original:
    """A module that a repository builds in CUDA, and ours that can take its place.

    `file` is where it lies inside the repository, relative to the script; None for an installed package.
    """

    name: str
    stand_in: str
    file: str | None = None


_KNN = Original("simple_knn._C", "d2_plugin.compat.nearest")


@dataclass(frozen=True)
class Recipe:
    """One codebase."""

    adapter: str
    """Name among the entry points `d2_plugin.adapters`."""
    build: Callable[[Adapter, Objects], Backbone]
    originals: tuple[Original, ...]
    model: tuple[str, str] = ("scene.gaussian_model", "GaussianModel")
    renderer: tuple[str, str] = ("gaussian_renderer", "render")
    heard: Callable[[Any, Mapping[str, Any]], None] | None = None
    """Hands the adapter what it needs from the named arguments of each render."""
    seen: dict[str, tuple[str, str]] = field(default_factory=lambda: {"scene": ("scene", "Scene")})
    """Classes whose latest instance is remembered, by its field of `Objects`."""


def _fudan(adapter: Adapter, objects: Objects) -> Backbone:
    return adapter(objects.model, objects.scene)


def _deformable3d(adapter: Adapter, objects: Objects) -> Backbone:
    return adapter(objects.model, objects.deform, warm_up=objects.options.warm_up)


def _hust4d(adapter: Adapter, objects: Objects) -> Backbone:
    return adapter(objects.model, objects.scene, "coarse")  # each render says the stage, see `_hear_stage`


def _hear_stage(adapter: Any, named: Mapping[str, Any]) -> None:
    if "stage" in named:
        adapter.enter_stage(named["stage"])


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
            Original("fused_ssim", "d2_plugin.compat.similarity"),
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
        _hust4d,
        (Original("diff_gaussian_rasterization", "d2_plugin.compat.depth"), _KNN),
        heard=_hear_stage,
    ),
}


def recipe(name: str) -> Recipe:
    """The recipe of that name; an unknown name is refused, with the known ones."""
    if name not in RECIPES:
        raise unknown_name("repository", name, RECIPES)
    return RECIPES[name]


def adapter_of(found: Recipe) -> Adapter:
    """The adapter of a recipe, by entry point."""
    return registry.load(registry.ADAPTERS, found.adapter)
