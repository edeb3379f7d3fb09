"""Looking: the same image as the backbone's own render."""

from dataclasses import replace

import pytest
import torch
from attach.repositories import VARIANTS
from tiny import BACKBONES, make_adapter, make_model, make_views

from d2_plugin.adapters.gsplat_dict import GsplatAdapter
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.viewing.rendering import MARKED, render_view

VIEW = make_views()[4]


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("background", [False, True])
def test_a_look_is_the_backbones_own_render(backbone: str, background: bool) -> None:
    model = make_model(backbone=backbone, background=background)
    if background:
        model.background.constant.data.fill_(0.8)
    with torch.no_grad():
        render = model.render(VIEW)
    seen = render_view(make_adapter(model), VIEW)
    assert torch.equal(seen.color, render.color.clamp(0, 1))
    assert torch.equal(seen.alpha, render.alpha)
    solid = render.alpha > 0.5
    assert solid.any()
    assert torch.allclose(seen.depth[solid], (render.depth_sum / render.alpha)[solid])
    assert not seen.depth[~solid].any()


@pytest.mark.parametrize("name", ["fudan", "deformable3d", "spacetime"])
def test_the_colours_of_official_trainers_are_those_they_render(name: str) -> None:
    standing = VARIANTS[name]()
    splats = standing.adapter.slice_at(VIEW)
    expected = standing.model.rgb[splats.rows].clamp(min=0)
    assert torch.allclose(standing.adapter.colors(VIEW, splats), expected, atol=1e-6)


def test_harmonics_of_gsplat_depend_on_the_direction() -> None:
    parameters = {
        "means": torch.tensor([[0.0, 0, 3], [0.5, 0, 3]]),
        "scales": torch.full((2, 3), -2.0),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        "opacities": torch.zeros(2),
        "sh0": torch.full((2, 1, 3), 0.25 / SH_C0),
        "shN": torch.zeros(2, 3, 3),
    }
    adapter = GsplatAdapter(parameters, {})
    splats = adapter.slice_at(VIEW)
    assert torch.allclose(adapter.colors(VIEW, splats), torch.full((2, 3), 0.75))
    parameters["shN"][:, 1] = 0.5
    centre = -VIEW.T_camera_world[:3, 3]
    z = torch.nn.functional.normalize(splats.means - centre, dim=-1)[:, 2:]
    assert torch.allclose(adapter.colors(VIEW, splats), (0.75 + 0.5 * 0.4886025 * z).expand(2, 3), atol=1e-5)


def test_an_adapter_without_colours_is_shown_in_grey() -> None:
    adapter = make_adapter(make_model())

    class Bare:
        settings, slice_at = adapter.settings, staticmethod(adapter.slice_at)

    seen = render_view(Bare(), VIEW)
    covered = seen.alpha > 0.9
    assert covered.any()
    assert torch.allclose(seen.color[covered], 0.6 * seen.alpha[covered][:, None], atol=1e-5)


def test_a_finer_image_has_no_hairlines_that_the_recorded_one_does_not_have() -> None:
    """In images of more pixels a blur of one of them would leave thin Gaussians thinner than training saw them."""
    model = make_model()
    with torch.no_grad():
        model.gaussians["log_scales"][:, 1:] -= 4
    K = VIEW.K.clone()
    K[:2] *= 4
    finer, adapter = replace(VIEW, K=K, width=4 * VIEW.width, height=4 * VIEW.height), make_adapter(model)
    recorded = render_view(adapter, VIEW).color
    apart = [(render_view(adapter, finer, scale=s).color[2::4, 2::4] - recorded).abs().mean() for s in (1.0, 4.0)]
    assert apart[1] < 0.4 * apart[0]


def test_those_that_d2_inserted_are_pointed_out() -> None:
    adapter = make_adapter(make_model())
    marked = torch.ones(len(adapter), dtype=torch.bool)
    seen = render_view(adapter, VIEW, marked=marked)
    assert torch.allclose(seen.color, seen.alpha[..., None] * torch.tensor(MARKED), atol=1e-4)
    faded = render_view(adapter, VIEW, marked=~marked).color
    assert torch.allclose(faded[..., 0], faded[..., 2], atol=1e-6)  # grey
