"""A trainer or a store of somebody's own that does something else than the contract says: named, never silent."""

import copy
import logging
import math
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from refusals import refuses
from tiny import ALL_HOOKS, ChangedStore, TinyStore, make_adapter, make_model, make_views
from torch import Tensor

from d2_plugin.adapters.yang4d import Yang4DAdapter
from d2_plugin.config import D2Config, DensifyConfig, DepthLossConfig, PruneConfig
from d2_plugin.errors import D2Error
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import DepthPrior, Edit, Splats

VIEWS = make_views()


def hooks(store: object = None, config: D2Config = ALL_HOOKS, adapter: object = None) -> D2Hooks:
    return D2Hooks(config, adapter or make_adapter(make_model()), store or TinyStore())


def verified(prior: DepthPrior, depth: float) -> DepthPrior:
    """The prior with one verified pixel of that depth."""
    changed = prior.depth.clone()
    changed[3, 4] = depth
    return prior._replace(depth=changed)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda prior: "x", "is a str, expected d2_plugin.protocol.DepthPrior or None"),
        (lambda prior: prior._replace(sigma=prior.depth[1:]), "has maps of several sizes"),
        (lambda prior: prior._replace(sigma="x"), "give tensors"),
        (lambda prior: prior._replace(depth=prior.depth.to_sparse()), "give tensors"),
        (lambda prior: prior._replace(colors=torch.rand(24, 32, 3)), "give uint8"),
        (lambda prior: prior._replace(reliability=-prior.depth), "reliability outside of 0..1"),
        (lambda prior: prior._replace(depth=prior.depth.numpy()), "has no depth as a map"),
        (lambda prior: prior._replace(depth=prior.depth.long()), "not float32: give depth, sigma and reliability"),
        (lambda prior: prior._replace(sigma=prior.depth.half()), "not float32: give depth, sigma and reliability"),
        (lambda prior: prior._replace(labels=torch.full_like(prior.labels, 9)), "has 768 labels that are none"),
        (lambda prior: prior._replace(depth=torch.full_like(prior.depth, math.nan)), "of 744 pixels .* 744"),
        (lambda prior: prior._replace(sigma=-torch.ones_like(prior.depth)), "of 744 pixels .* 744"),
    ],
)
def test_a_prior_that_cannot_be_is_refused(change: Callable[[DepthPrior], object], says: str) -> None:
    refuses(f"the prior of camera cam0, frame 0 .*{says}", hooks(ChangedStore(change)).loss, 1, VIEWS[0])


def test_a_prior_in_float64_densifies() -> None:
    d2 = hooks(ChangedStore(lambda prior: prior._replace(depth=prior.depth.double())))
    for step in range(1, 7):
        d2.loss(step, VIEWS[0])
        d2.step(step)
    assert int((d2.inserted_at > 0).sum()) > 0


@pytest.mark.parametrize("depth", [math.nan, math.inf, -3.0, 0.0])
def test_some_pixels_of_a_prior_that_cannot_be_are_counted_once_per_camera(depth: float, caplog) -> None:
    d2 = hooks(ChangedStore(lambda prior: verified(prior, depth)))
    for step in (1, 2):
        d2.loss(step, [view for view in VIEWS if view.camera == "cam0"])
    assert caplog.text.count("of 744 pixels labelled with a known depth 1 have NaN") == 1


FIRST = VIEWS[0]


def test_rounding_in_a_pose_and_a_frame_that_is_a_tensor_are_no_mistake() -> None:
    d2, rounded = hooks(), FIRST.T_camera_world + torch.tensor([[0.0], [0], [0], [1.5e-8]])
    for step in (1, 2):
        d2.loss(step, replace(FIRST, frame=torch.tensor(FIRST.frame), T_camera_world=rounded))
    assert len(d2.state_dict()["views"]["views"]) == 1


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        *(({"T_camera_world": pose}, "is no rotation and shift, or K has") for pose in (
            torch.zeros(4, 4), torch.diag(torch.tensor([-1.0, 1, 1, 1])), torch.diag(torch.tensor([1.1, 1.1, 1.1, 1])),
            torch.diag(torch.tensor([1.0, 1, 1, 0])))),
        ({"K": FIRST.K * torch.tensor([[1.0, 1, 1], [1, 1, 1], [1, 1, 0]])}, "is no rotation and shift, or K has"),
        ({"K": FIRST.K + torch.tensor([[0.0, 0, 0], [5, 0, 0], [0, 0, 0]])}, "is no rotation and shift, or K has"),
        ({"K": FIRST.K.to("meta")}, "K of the view .* expected a plain tensor"),
        ({"K": FIRST.K + 0j}, "K of the view .* expected a plain tensor"),
        ({"T_camera_world": torch.eye(4).to_sparse()}, "world of the view .* a plain tensor"),
        ({"K": torch.zeros(3, 3)}, "focal lengths 0 and 0, expected positive"),
        ({"K": torch.full((3, 3), torch.nan)}, "K of the view .* not finite"),
        ({"K": torch.eye(4)}, r"K of the view .* is torch.float32 \(4, 4\), expected a plain tensor \(3, 3\)"),
        ({"T_camera_world": None}, "T_camera_world .* is NoneType, expected a plain tensor"),
        ({"width": 0}, "0x24 pixels, expected at least one"),
        ({"width": 32.0}, "the width of a view must be a whole number, got 32.0"),
        ({"time": math.nan}, "the time of a view must be"),
        ({"frame": 0.5}, "the frame of a view must be"),
        ({"camera": None}, "the camera of a view must be"),
    ],
)  # fmt: skip
def test_a_view_that_no_image_has_is_refused(changes: dict[str, object], says: str) -> None:
    refuses(says, hooks().loss, 1, replace(FIRST, **changes))


@pytest.mark.parametrize("views", [None, [None], [FIRST, None], "cam0"])
def test_what_is_no_view_or_camera_is_refused(views: object) -> None:
    refuses("a str" if views == "cam0" else "got None as a view", hooks().loss, 1, views)


def test_a_step_that_falls_repeats_or_differs_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    def after(*calls: tuple[str, int]) -> None:
        d2 = hooks(config=D2Config(depth_loss=DepthLossConfig()))
        for name, step in calls:
            d2.loss(step, VIEWS[0]) if name == "loss" else d2.step(step)

    after(("loss", 1), ("loss", 1), ("step", 1), ("loss", 2), ("step", 2), ("step", 5), ("loss", 9))
    assert "which rises" not in caplog.text
    for wrong in (
        [("loss", 5), ("step", 5), ("loss", 4)],
        [("loss", 5), ("step", 5), ("loss", 5)],
        [("step", 5), ("step", 5)],
        [("loss", 5), ("step", 6)],
        [("loss", 5), ("loss", 4)],
    ):
        caplog.clear()
        after(*wrong, *wrong)
        assert caplog.text.count("which rises from one to the next") == 1
    for one, other in (("loss", "step"), ("step", "loss")):
        after(*((one, step) for step in range(1, 300)))
        assert caplog.text.count(f"d2.{other} was not called in 100 steps") == 1


@pytest.mark.parametrize(
    ("given", "says"),
    [
        *(({"store": store}, r"the store is a \w+ without prior\(camera, frame\)")
          for store in (object(), SimpleNamespace(prior=5), TinyStore)),
        *(({"config": config}, "config of D2Hooks must be a table of settings")
          for config in (None, 5, {}, D2Config, DensifyConfig())),
        ({"adapter": Yang4DAdapter}, "the backbone is the class Yang4DAdapter: give an object of it"),
        ({"adapter": object()}, "the backbone is a object without settings, __len__, view, slice_at"),
    ],
)  # fmt: skip
def test_what_is_no_store_configuration_or_backbone_is_refused(given: dict[str, object], says: str) -> None:
    refuses(says, hooks, **given)


def inserting(said: object) -> D2Hooks:
    """Hooks on a backbone that inserts nothing, and says this."""
    adapter = make_adapter(make_model())
    adapter.insert = lambda points: said
    d2 = hooks(config=D2Config(densify=DensifyConfig(start=1, every=1)), adapter=adapter)
    d2.loss(1, VIEWS[0])
    return d2


def test_a_remove_that_keeps_what_it_should_delete_is_refused() -> None:
    adapter = make_adapter(make_model())
    remove, edit = adapter.remove, Edit(remove=torch.arange(len(adapter)) % 3 == 0)
    adapter.remove = lambda mask: remove(~mask)
    refuses("mask of 20 Gaussians and took 40: True in it", hooks(adapter=adapter)._remove, 1, [("own", edit)])


def test_a_loss_without_a_gradient_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    d2 = hooks()
    assert d2.loss(1, FIRST).requires_grad
    assert "has no gradient" not in caplog.text
    with torch.no_grad():
        for step in (2, 3):
            d2.loss(step, FIRST)
    assert caplog.text.count("d2.loss has no gradient and supervises nothing: call it outside of torch.no_grad") == 1


def test_an_insert_that_adds_nothing_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    d2 = inserting(0)
    for step in (1, 2):
        d2.step(step)
    assert caplog.text.count("insert() of the backbone added none of") == 1


@pytest.mark.parametrize("change", [lambda i: i >= 0, Tensor.tolist, lambda i: i[:-1], lambda i: i + 99, Tensor.float])
def test_a_report_that_is_no_index_is_refused(change: Callable) -> None:
    adapter = make_adapter(make_model())
    on_resize = adapter.on_resize
    adapter.on_resize = lambda listener: on_resize(lambda index: listener(change(index)))
    mask = torch.arange(len(adapter)) < 3
    refuses(
        "the backbone reports .*`d2_plugin.testing.check_backbone`",
        hooks(adapter=adapter)._remove,
        1,
        [("own", Edit(remove=mask))],
    )


@pytest.mark.parametrize("said", [3, None, True])
def test_an_insert_that_says_another_number_is_refused(said: object) -> None:
    refuses(r"insert\(\) was given .* and returned .*return how many were added", inserting(said).step, 1)


@pytest.mark.parametrize("name", ["gsplat", "fudan", "yang4d", "ex4dgs"])
@pytest.mark.parametrize("model", [(), (object(),), (None, None)], ids=["nothing", "object", "none"])
def test_an_adapter_of_the_wrong_object_says_so(name: str, model: tuple) -> None:
    sentence = r"the adapter 'gsplat' cannot take object .*docstring of GsplatAdapter"
    refuses(sentence if (name, len(model)) == ("gsplat", 1) else "", D2Hooks.attach, {}, name, *model)


def test_a_state_of_other_things() -> None:
    d2 = hooks()
    state = d2.state_dict()
    three, only_prune = {"streak": torch.zeros(3, dtype=torch.int64)}, replace(ALL_HOOKS, densify=None, depth_loss=None)
    for other, says in (
        ({}, "has no hooks, views, generator, idle, retired: give what d2.state_dict"),
        (None, "cannot read the state of D2"),
        (hooks(config=only_prune).state_dict(), r"has \['densify', 'depth_loss', 'prune'\]"),
        (state | {"hooks": state["hooks"] | {"prune": three}}, r"streak of prune .* of 3 Gaussians"),
        (state | {"hooks": {"densify": {}, "prune": None, "depth_loss": {}}}, "cannot read the state of D2"),
        (state | {"inserted_at": torch.zeros(2, dtype=torch.int32)}, "inserted_at of d2 in the checkpoint"),
        (state | {"views": 5}, "cannot read the state of D2"),
        (state | {"generator": torch.zeros(3)}, "cannot read the state of D2"),
        (state | {"idle": [1]}, "cannot read the state of D2"),
        (state | {"retired": "x"}, "cannot read the state of D2"),
    ):
        refuses(says, d2.load_state_dict, other)
    d2.load_state_dict(state)


@pytest.mark.parametrize("step", [None, "x", -1, 1.5, True])
def test_what_is_no_step(step: Any) -> None:
    d2 = hooks()
    for call in (lambda: d2.step(step), lambda: d2.loss(step, VIEWS[:1])):
        refuses("the number of the optimizer's step, which d2.loss and d2.step take, must be", call)


def in_float64(splats: Splats) -> Splats:
    return Splats(*(part.double() if part.is_floating_point() else part for part in splats))


def torn(splats: Splats) -> Splats:
    """Of one Gaussian it is not said which it is."""
    return splats._replace(rows=splats.rows[:-1])


@pytest.mark.parametrize(
    ("change", "config", "says"),
    [
        (in_float64, {"densify": DensifyConfig(start=0, every=1)}, "densify inserts float32 .* returned torch.float64"),
        (torn, {"prune": PruneConfig(start=0, every=1)}, "returned means .*, rows .*, expected M rows each"),
    ],
)
def test_a_slice_that_cannot_be_is_refused(change, config, says) -> None:
    adapter = make_adapter(make_model())
    whole = adapter.slice_at
    adapter.slice_at = lambda view: change(whole(view))
    d2 = hooks(config=D2Config(**config), adapter=adapter)
    d2.loss(1, VIEWS)
    refuses(says, d2.step, 1)


@contextmanager
def float64_by_default() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize(
    "around",
    [float64_by_default, lambda: torch.device("meta"), torch.inference_mode],
    ids=["float64", "meta", "inference"],
)
def test_what_torch_does_to_every_tensor_is_refused_where_d2_cannot_work_with_it(around: Callable) -> None:
    d2 = hooks()
    for call in (
        lambda: d2.loss(1, VIEWS[0]),
        lambda: d2.step(1),
        lambda: D2Hooks(ALL_HOOKS, d2.backbone, TinyStore()),
    ):
        with around(), pytest.raises(D2Error, match="D2 needs float32 as the default dtype"):
            call()


def test_a_counter_that_jumps_over_an_edit_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    """As that of micro steps does, and that of a trainer which counts images."""
    config = D2Config(densify=DensifyConfig(start=2, stop=40, every=3))

    def after(*steps: int) -> None:
        caplog.clear()
        d2 = hooks(config=config)
        for step in steps:
            d2.loss(step, VIEWS[0])
            d2.step(step)

    after(*range(1, 8))
    after(9, 10, 50)
    assert "densify was due at 11" in caplog.text
    after(*range(3, 40, 3))
    said = "d2.step got step 6 after 3, and densify was due at 5: it is left out. Call d2.step after each step"
    assert caplog.text.count("it is left out") == 1
    assert said in caplog.text
    after(*range(1, 40), 100, 200)
    assert "left out" not in caplog.text


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_hooks_are_not_copied(copied: Callable) -> None:
    refuses(r"neither copied nor pickled: .* give them d2.state_dict\(\)", copied, hooks())


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps])
def test_a_copy_of_a_backbone_with_hooks_says_that_the_backbone_is_meant(copied: Callable) -> None:
    refuses("and a backbone that they listen to, are neither copied nor pickled", copied, hooks().backbone)


def test_two_threads_at_once_are_refused() -> None:
    inside, go_on = threading.Event(), threading.Event()

    def waiting(prior: DepthPrior) -> DepthPrior:
        inside.set()
        go_on.wait(20)
        return prior

    d2 = hooks(ChangedStore(waiting))
    first = threading.Thread(target=d2.loss, args=(1, VIEWS[0]))
    first.start()
    assert inside.wait(20)
    try:
        refuses("two threads use one D2Hooks at once", d2.loss, 1, VIEWS[1])
    finally:
        go_on.set()
        first.join()
    d2.step(1)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_child_that_was_forked_after_use_with_threads_does_not_hang(threads: Callable[[int], None]) -> None:
    threads(2)
    d2 = hooks()

    def work(step: int) -> None:
        torch.ones(3_000_000).exp().sum()
        d2.loss(step, VIEWS[step])
        d2.step(step)

    work(1)
    child = os.fork()
    if child == 0:
        try:
            work(2)
        except BaseException:
            os._exit(3)
        os._exit(0)
    hung = threading.Timer(100, os.kill, (child, signal.SIGKILL))
    hung.start()
    ended = os.waitpid(child, 0)[1]
    hung.cancel()
    assert ended == 0
    work(2)


class Filmed(Yang4DAdapter):
    """An adapter that knows the images of its cameras."""

    images: dict[tuple[str, int], Tensor]

    def view(self, camera: SimpleNamespace) -> object:
        return camera.view

    def image(self, camera: SimpleNamespace) -> Tensor:
        return camera.original_image


def scene(moved: float, noise: float) -> Tensor:
    """An image [3, H, W]: something bright before a texture, moved by some pixels."""
    y, x = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    image = 0.4 + 0.2 * torch.sin(x / 3 + torch.arange(3)[:, None, None]) * torch.cos(y / 4)
    image = torch.where(((x - 10 - moved) ** 2 + (y - 12) ** 2 < 25), 0.95, image)
    return (image + noise * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)


@pytest.mark.parametrize(("moved", "noise", "gain", "warned"), [(0, 0.02, 0.8, False), (9, 0, 1, True)])
def test_a_prior_of_another_frame_is_named(moved: float, noise: float, gain: float, warned: bool, caplog) -> None:
    def made(prior: DepthPrior) -> DepthPrior:
        return prior._replace(colors=(scene(0, 0) * 255).byte().permute(1, 2, 0))

    d2 = hooks(ChangedStore(made), adapter=Filmed(make_model()))
    camera = SimpleNamespace(view=VIEWS[0], original_image=gain * scene(moved, noise))
    with caplog.at_level(logging.WARNING):
        d2.loss(1, camera)
        d2.step(1)
        d2.loss(2, camera)
    assert caplog.text.count("does the key name another frame?") == int(warned)


@pytest.mark.parametrize("image", [torch.ones(4, 24, 32), torch.ones(3, 12, 16)], ids=["with opacity", "cut"])
def test_an_image_that_is_not_the_priors_is_not_compared(image: Tensor) -> None:
    camera = SimpleNamespace(view=VIEWS[0], original_image=image)
    assert hooks(adapter=Filmed(make_model())).loss(1, camera) > 0
