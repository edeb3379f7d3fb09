"""`d2 export --keep`: what goes is what images would miss least, and what is left is trained on."""

import numpy as np
import pytest
import torch
from viewing.export.scenes import make_scene, sharp_model

from d2_plugin.errors import D2Error
from d2_plugin.runs.start import make_view
from d2_plugin.viewing.export import compact


def test_the_energy_of_a_gaussian_is_what_the_image_differs_by_without_it() -> None:
    model = sharp_model("yang4d", 24)
    viewed = make_scene(model).viewed
    view, generator = make_view(viewed.recording, "middle", 4), torch.Generator().manual_seed(0)
    energies = torch.zeros(24)
    for _ in range(100):
        compact._add_energies(energies, viewed.backbone, view, generator)
    with torch.no_grad():
        splats = viewed.backbone.slice_at(view)
        whole = compact._color(viewed.backbone, view, splats.opacities)
        true = torch.zeros(24)
        for place, row in enumerate(splats.rows):
            without = splats.opacities.clone()
            without[place] = 0
            true[row] = (compact._color(viewed.backbone, view, without) - whole).square().sum()
    assert torch.equal(energies == 0, true == 0)
    seen = true > 0.01 * true.max()
    assert seen.sum() > 10
    assert (energies[seen] / 100 / true[seen]).log2().abs().median() < 0.3
    assert np.corrcoef(energies.argsort().argsort(), true.argsort().argsort())[0, 1] > 0.95


def test_a_checkpoint_of_another_trainer_is_refused() -> None:
    viewed = make_scene(sharp_model("yang4d")).viewed
    del viewed.backbone.model
    with pytest.raises(D2Error, match="tiny is no run of `d2 train`: leave out --keep"):
        compact.compacted(viewed, 0.5)
