"""What a trainer rendered in the present step, found by camera and frame."""

from __future__ import annotations

from typing import Generic, TypeVar

from d2_plugin.protocol import View

Render = TypeVar("Render")


class Renders(Generic[Render]):
    """Renders of the views of one step, a batch of them as well; each is handed out once.

    A render holds a graph, and is out of date once the parameters change: whoever keeps them calls `forget` then.
    """

    def __init__(self) -> None:
        self._by_key: dict[tuple[str, int], Render] = {}

    def put(self, view: View, render: Render) -> None:
        """Keep the render of a view; a later one of the same camera and frame takes its place."""
        self._by_key[view.camera, view.frame] = render

    def take(self, view: View) -> Render | None:
        """The render of this view, if there is one that has not been handed out."""
        return self._by_key.pop((view.camera, view.frame), None)

    def forget(self) -> None:
        """Forget all renders."""
        self._by_key.clear()
