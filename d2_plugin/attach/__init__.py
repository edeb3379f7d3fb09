"""Run somebody else's train.py with D2 attached and no line of it edited:

    python -m d2_plugin.attach fudan --d2 d2.toml -- train.py --config configs/dynerf/sear_steak.yaml

Three choke points are wrapped before the script runs: `GaussianModel.training_setup` (attach), the renderer's `render`
(the loss) and the optimizer's `step` and `zero_grad` (the edits). Nothing is written into the repository.
"""
