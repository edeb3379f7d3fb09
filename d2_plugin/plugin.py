"""D2Hooks: the only thing a trainer sees. Three lines attach it:

d2 = D2Hooks.from_config("d2.toml", backbone=adapter, iterations=30_000)   # after the optimizer exists
loss = loss + d2.loss(step, views)                                         # before backward, never +=
d2.step(step)                                     # after optimizer.step() and zero_grad(), before saving
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar, cast

import torch
from torch import Tensor

from d2_plugin.config import D2Config
from d2_plugin.errors import D2Error
from d2_plugin.hooks import HOOKS, Context, Hook, PriorLoader
from d2_plugin.hooks.edits import Idle, faintest, followed, limited
from d2_plugin.hooks.expected import (
    StepOrder,
    check_backbone,
    check_inserted,
    check_state,
    check_step,
    check_surroundings,
    converted,
    mistake_of,
    small_image,
)
from d2_plugin.hooks.finite import FiniteCheck
from d2_plugin.hooks.prior import Store
from d2_plugin.hooks.reports import OnReport, Report, RunLog, ScalarWriter, Trace
from d2_plugin.hooks.views import ViewSampler
from d2_plugin.protocol import Backbone, Edit, Points, View, call_optional, schedule_step
from d2_plugin.reading import parsing, said
from d2_plugin.registry import ADAPTERS, load
from d2_plugin.values import checked_arguments, fitting

_log = logging.getLogger(__name__)

if hasattr(os, "register_at_fork"):
    # OpenMP's threads are not there after a fork, and a child that used them would wait for them for ever.
    os.register_at_fork(after_in_child=functools.partial(torch.set_num_threads, 1))

Method = TypeVar("Method", bound=Callable[..., Any])


def _by_one_thread(method: Method) -> Method:
    """Refuse a call while another thread is within one; compute in full precision, outside of torch.compile."""

    @functools.wraps(method)
    def alone(self: D2Hooks, *given: Any, **named: Any) -> Any:
        if not self._used.acquire(blocking=False):
            raise D2Error("two threads use one D2Hooks at once: call d2.loss and d2.step from the thread that trains")
        try:
            # Outside of the trainer's autocast: 16 bits place points pixels away from where they are.
            on_gpu = torch.autocast("cuda", enabled=False) if torch.is_autocast_enabled() else contextlib.nullcontext()
            with torch.autocast("cpu", enabled=False), on_gpu:
                return method(self, *given, **named)
        finally:
            self._used.release()

    return cast(Method, getattr(torch, "_disable_dynamo", lambda function: function)(alone))


class D2Hooks:
    """Runs the configured hooks on a backbone.

    With no hook configured, a run is bitwise the bare trainer's: the loss is the number 0.0, nothing is edited and
    the global random state is never touched.
    """

    def __init__(
        self, config: D2Config, backbone: Backbone, store: Store | None = None, hooks: Mapping[str, Hook] | None = None
    ) -> None:
        """The silent form of `from_config`, which documents the arguments."""
        check_backbone(backbone)
        fitting(D2Config, config, "config of D2Hooks")
        self.config, self.backbone = config, backbone
        self.hooks: dict[str, Hook] = {name: HOOKS[name].hook(getattr(config, name)) for name in config.hooks}
        for name, hook in (hooks or {}).items():
            if name in HOOKS:
                raise D2Error(f"a hook of your own is named '{name}', as one of D2's ({', '.join(HOOKS)}): rename it")
            self.hooks[name] = hook
        self.trace: deque[Trace] = deque(maxlen=1000)
        self.generator = torch.Generator().manual_seed(config.seed)
        self._sampler = ViewSampler()
        self._finite = FiniteCheck(backbone, config.finite_every)
        self._order, self._used = StepOrder(), threading.Lock()
        self._count = len(backbone)
        self._warned = self._idle_insert = self._passed_over = self._detached = False
        self._inserting = 0  # the step while the backbone inserts for us, else 0
        self._fresh = torch.zeros(0, dtype=torch.int32, device="cpu")  # 1: the trainer added it since our last step
        self.inserted_at = torch.zeros(self._count, dtype=torch.int32, device="cpu")
        """Per Gaussian [N], the step at which D2 inserted it; 0 for the backbone's own."""
        self._idle = Idle(self.hooks, config.retire_after)
        self.log = RunLog(self.hooks)
        self.prior: PriorLoader | None = None
        """Where the hooks look up depth; None where there is no hook."""
        if self.hooks:
            check_surroundings()
            from d2_plugin.store.exported import renamed_by

            opened = store if store is not None else _open_store(config, self.hooks)
            self.prior = PriorLoader(opened, config.prior_memory_mb, renamed_by, config.believe)
            backbone.on_resize(self._follow)
            self._warn_of_no_step()

    @classmethod
    @checked_arguments
    def from_config(
        cls,
        config: str | Path | Mapping[str, Any] | D2Config,
        backbone: Backbone,
        store: Store | None = None,
        hooks: Mapping[str, Hook] | None = None,
        *,
        iterations: int | None = None,
        on_report: OnReport | None = None,
        writer: ScalarWriter | None = None,
    ) -> D2Hooks:
        """Attach the configured hooks to a backbone and log what was attached, see `RunLog.start`.

        Args:
            config: a TOML file, a mapping of its content, or a D2Config, whose schedules stay as they are.
            backbone: an adapter, or a class of your own, see `d2_plugin.protocol.Backbone`.
            store: anything with `prior(camera, frame) -> DepthPrior | None`; by default the folder `config.prior`.
            hooks: more of them by name, as objects: your own, or what D2 is compared with.
            iterations: length of the run in steps; schedules that the configuration leaves out follow from it (`pace`).
            on_report: called with the `Report` of every step.
            writer: anything with `add_scalar(tag, value, step)`, a TensorBoard SummaryWriter for instance.
        """
        pace = functools.partial(schedule_step, backbone)
        if isinstance(config, (str, Path)):
            config = D2Config.from_toml(config, iterations, pace)
        elif not isinstance(config, D2Config):
            table = config if iterations is None else {"iterations": iterations, **config}
            config = D2Config.from_dict(table, pace=pace)
        if iterations is not None and config.iterations not in (None, iterations):
            said = (
                "the configuration is of a run of %d steps and the trainer says %d: schedules are those of the former"
            )
            _log.warning(said, config.iterations, iterations)
        d2 = cls(config, backbone, store, hooks)
        d2.log.start(backbone, d2.prior, config.iterations or iterations, on_report, writer)
        return d2

    @classmethod
    @checked_arguments
    def attach(
        cls,
        config: str | Path | Mapping[str, Any] | D2Config,
        adapter: str,
        *model: Any,
        iterations: int | None = None,
        on_report: OnReport | None = None,
        writer: ScalarWriter | None = None,
        **options: Any,
    ) -> D2Hooks:
        """`from_config` with a registered adapter by its name, built from the trainer's own objects and `options`.

        The first of the three lines where there is an adapter:
        `d2 = D2Hooks.attach("d2.toml", "fudan", gaussians, iterations=opt.iterations)`.
        """
        build = load(ADAPTERS, adapter)
        try:
            backbone = build(*model, **options)
        except D2Error:
            raise
        except (AttributeError, KeyError, TypeError, ValueError) as failure:
            given = ", ".join(type(part).__name__ for part in (*model, *options.values())) or "nothing"
            raise D2Error(
                f"the adapter '{adapter}' cannot take {given} ({said(failure)}): give the trainer's own objects, as "
                f"the docstring of {getattr(build, '__name__', adapter)} says"
            ) from failure
        return cls.from_config(config, backbone, iterations=iterations, on_report=on_report, writer=writer)

    @property
    def retired(self) -> dict[str, int]:
        """Hooks that stopped because their last evaluations changed next to nothing, and the step of the last one."""
        return self._idle.retired

    @_by_one_thread
    def loss(self, step: int, views: object) -> Tensor | float:
        """The hooks' share of this step's loss: a scalar on the backbone's device, or 0.0 when there is none.

        `views` is the trainer's own camera object, or a list of them for a batch.
        """
        if self.prior is None:
            return 0.0
        self._begin(step)
        batch = views if isinstance(views, (list, tuple)) else [views]
        if batch and not self.prior.named:
            self.prior.name_by(call_optional(self.backbone, "image_name", batch[0]))
        shown = [converted(self.backbone, camera) for camera in batch]
        for camera, view in zip(batch, shown):
            if self._sampler.add(view) and (image := small_image(self.backbone, camera)) is not None:
                self.prior.images[view.camera, view.frame] = image
        context = self._context(step, shown)
        total: Tensor | float = 0.0
        for name, hook in self._due(step, ends=False):
            term = hook.loss(context)
            if term is not None:
                self.trace.append(Trace(step, name, "loss", 0))
                self.log.record_loss(name, term)
                total = total + term if isinstance(total, Tensor) else term
        if isinstance(total, Tensor) and not (total.requires_grad or self._detached):
            self._detached = True
            _log.warning(
                "d2.loss has no gradient and supervises nothing: call it outside of torch.no_grad, and let slice_at() "
                "return tensors that are computed from trained parameters"
            )
        self._finite.remember(total, shown)
        return total

    def prefetch(self, cameras: Iterable[object]) -> None:
        """Read the priors of the views that come next in a thread of its own; for a trainer that knows them."""
        if self.prior is not None and self.prior.named:
            known = [
                (c.camera, c.frame) if isinstance(c, View) else call_optional(self.backbone, "prior_key", c)
                for c in cameras
            ]
            self.prior.prefetch(key for key in known if key is not None)

    @_by_one_thread
    @torch.no_grad()
    def step(self, step: int) -> Report:
        """Insert and remove what the hooks ask for, in one edit; call after the optimizer's step and zero_grad."""
        if not self.hooks:
            return Report(gaussians=len(self.backbone), step=step)
        self._begin(step)
        due = self._due(step, ends=True)
        self._finite.check(step, any(name in HOOKS and HOOKS[name].edits_structure for name, _ in due))
        context = self._context(step, ())
        proposals = [(name, hook.edit(context)) for name, hook in due]
        edits = [(name, edit) for name, edit in proposals if edit is not None]
        for name, edit in proposals:
            self._retire_if_idle(step, name, edit, context)
        edits += self._above_cap(step, context)
        removed, inserted = self._remove(step, edits), self._insert(step, edits)
        report = Report(inserted, removed, len(self.backbone), step)
        self.log.record_step(report)
        self._fresh = self._fresh[:0]
        return report

    def state_dict(self) -> dict[str, Any]:
        """Everything an exact continuation needs; save it beside the trainer's checkpoint."""
        self._finite.before_saving()
        return {
            "step": self._finite.step,
            "hooks": {name: hook.state_dict() for name, hook in self.hooks.items()},
            "views": self._sampler.state_dict(),
            "generator": self.generator.get_state(),
            "inserted_at": self.inserted_at.clone() if self.hooks else torch.zeros(len(self.backbone)).int(),
            "idle": dict(self._idle.evaluations),
            "retired": dict(self.retired),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`, once the backbone is restored; refuses the state of other hooks than these."""
        with parsing("the state of D2", "give what d2.state_dict() returned, of this version"):
            check_state(state, self.hooks, len(self.backbone))
            for name, hook in self.hooks.items():
                hook.load_state_dict(state["hooks"][name])
            self._sampler.load_state_dict(state["views"])
            self.generator.set_state(state["generator"].cpu())
            self._idle.load(state)
        self._order = StepOrder()
        self._count, self._fresh = len(self.backbone), self._fresh[:0]
        self._finite.step = self._finite.saved = state.get("step", 0)
        self.inserted_at = state.get("inserted_at", torch.zeros(self._count, dtype=torch.int32)).cpu()

    def __reduce__(self) -> NoReturn:
        raise D2Error(
            "D2Hooks, and a backbone that they listen to, are neither copied nor pickled: attach new ones to a new "
            "backbone and give them d2.state_dict()"
        )

    def _begin(self, step: int) -> None:
        """Give the backbone the number of the step, and notice changes that nobody reported."""
        check_step(step)
        check_surroundings()
        call_optional(self.backbone, "begin_step", step)
        self._check_count()

    def _due(self, step: int, ends: bool) -> list[tuple[str, Hook]]:
        if not call_optional(self.backbone, "active", step, default=True):
            return []  # in its other stages a trainer may count anew
        if ends:
            self._name_passed_over(step)
        self._order.check(step, ends)
        now = schedule_step(self.backbone, step)
        if ends and now == schedule_step(self.backbone, step - 1):
            return []  # it was due at an earlier step of this pace
        return [
            (name, hook)
            for name, hook in self.hooks.items()
            if (hook.config.due_when_retired if name in self.retired else hook.config.due)(now)
        ]

    def _warn_of_no_step(self) -> None:
        last = None if self.config.iterations is None else schedule_step(self.backbone, self.config.iterations)
        for name, hook in self.hooks.items():
            start, stop = hook.config.start, hook.config.stop
            if stop is not None and start >= stop:
                _log.warning("%s has no step: it starts at step %d and stops before step %d", name, start, stop)
            elif last is not None and start > last:
                _log.warning("%s has no step: it starts at step %d of a run of %d", name, start, last)

    def _name_passed_over(self, step: int) -> None:
        """Warn, once, of an edit that was due between the last `step` and this one: it is not made up for."""
        done = self._order.done
        # Of a long jump its end is looked at: hooks are due more often than every 10,000 steps.
        numbers = () if done < 0 or self._passed_over else range(max(done + 1, step - 10_000), step)
        for number in numbers:
            now = schedule_step(self.backbone, number)
            due = [n for n, h in self.hooks.items() if n in HOOKS and HOOKS[n].edits_structure and h.config.due(now)]
            due = [name for name in due if name not in self.retired]
            if due and now != schedule_step(self.backbone, number - 1):
                self._passed_over = True
                _log.warning(
                    "d2.step got step %d after %d, and %s was due at %d: it is left out. Call d2.step after each step "
                    "of the optimizer, with numbers that rise by one", step, done, " and ".join(due), number,
                )  # fmt: skip
                return

    def _context(self, step: int, views: Sequence) -> Context:
        def sample() -> Sequence:
            left = self.hooks["densify"].config.left(now) if "densify" in self.hooks else 0
            return known.sample(max(self.config.views_per_evaluation, known.due(left)), self.generator)

        assert self.prior is not None, "a step without hooks has no context"
        now, known, motion = schedule_step(self.backbone, step), self._sampler, self.config.motion
        seen = sample, known.instants, known.beside, motion is not None and motion.insert
        return Context(now, self.backbone, views, self.prior, self.generator, *seen)

    def _retire_if_idle(self, step: int, name: str, edit: Edit | None, context: Context) -> None:
        if name not in HOOKS or not HOOKS[name].edits_structure or name in self.retired or not context.evaluation:
            return
        changes, settling = 0 if edit is None else edit.changes, self.hooks[name].settling
        if self._idle.retires(name, step, changes, len(self.backbone), settling):
            self.trace.append(Trace(step, name, "retire", 0))
            _log.info("%s retires at step %d: its last evaluations changed next to nothing", name, step)

    def _above_cap(self, step: int, context: Context) -> list[tuple[str, Edit]]:
        """What the trainer has just added above `densify.max_gaussians`, where the user has set that."""
        most = None if self.config.densify is None else self.config.densify.max_gaussians
        excess = 0 if most is None else len(self.backbone) - most
        if excess <= 0 or not self._fresh.any() or not call_optional(self.backbone, "active", step, default=True):
            return []
        remove = faintest(self._fresh, excess, (self.backbone.slice_at(view) for view in context.sample()))
        if not self.log.capped:
            _log.info("step %d: what the trainer adds above max_gaussians = %d is removed, faintest first", step, most)
        self.log.capped += int(remove.sum())
        return [("densify", Edit(remove=remove))]

    def _remove(self, step: int, edits: Sequence[tuple[str, Edit]]) -> int:
        masks = [(name, edit.remove) for name, edit in edits if edit.remove is not None]
        if not masks:
            return 0
        union = limited(torch.stack([mask for _, mask in masks]).any(0), self.config.remove_at_most, step)
        self.trace.extend(Trace(step, name, "remove", int((mask & union).sum())) for name, mask in masks)
        before, removed = len(self.backbone), int(union.sum())
        self.backbone.remove(union)
        if (took := before - len(self.backbone)) != removed:
            raise D2Error(f"remove() was given a mask of {removed} Gaussians and took {took}: True in it means delete")
        return removed

    def _insert(self, step: int, edits: Sequence[tuple[str, Edit]]) -> int:
        proposals = [(name, edit.insert) for name, edit in edits if edit.insert is not None]
        if not proposals:
            return 0
        points, before = Points.joined([points for _, points in proposals]), len(self.backbone)
        self._inserting = step
        try:
            inserted = self.backbone.insert(points)
        finally:
            self._inserting = 0
        check_inserted(inserted, len(points.positions), len(self.backbone) - before)
        if not inserted and len(points.positions) and not self._idle_insert:
            self._idle_insert = True
            _log.warning("insert() of the backbone added none of %d points: D2 adds nothing", len(points.positions))
        self.trace.append(Trace(step, proposals[0][0], "insert", inserted))
        return inserted

    def _follow(self, index: Tensor) -> None:
        host = index.cpu() if isinstance(index, Tensor) else index  # the one wait of an edit's report
        if mistake := mistake_of("the backbone", host, self._count, len(self.backbone)):
            raise D2Error(f"{mistake}; `d2_plugin.testing.check_backbone` finds such mistakes in adapters")
        for hook in self.hooks.values():
            hook.follow(index)
        self._count = len(host)
        self.inserted_at = followed(self.inserted_at, host, self._inserting)
        self._fresh = followed(self._fresh, host, int(not self._inserting))

    def _check_count(self) -> None:
        """The safety net of the contract: a change of N that nobody reported resets per-Gaussian state."""
        if len(self.backbone) == self._count:
            return
        for hook in self.hooks.values():
            hook.reset()
        if not self._warned:
            warnings.warn(
                f"the backbone went from {self._count} to {len(self.backbone)} Gaussians without telling its "
                "listeners: pruning starts counting anew; report changes through on_resize",
                stacklevel=3,
            )
            self._warned = True
        self._count, self._fresh = len(self.backbone), self._fresh[:0]
        self.inserted_at = torch.zeros(self._count, dtype=torch.int32, device="cpu")


def _open_store(config: D2Config, hooks: Mapping[str, Hook]) -> Store:
    if config.prior is None:
        needing = f"{', '.join(hooks)} need{'s' if len(hooks) == 1 else ''}"
        raise D2Error(f"{needing} a depth prior: set `prior` to the folder that `d2 priors` wrote")
    from d2_plugin.store.exported import opened

    store: Store = opened(config.prior, config.exported)
    return store
