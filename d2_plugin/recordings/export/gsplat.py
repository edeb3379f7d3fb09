"""The layout of gsplat's examples: a COLMAP model of one instant, held-out images where its parser looks for them."""

from __future__ import annotations

from d2_plugin.errors import D2Error
from d2_plugin.recordings.export.base import Export, Written
from d2_plugin.recordings.export.colmap import Image, write_model


def write_gsplat(export: Export) -> Written:
    """sparse/0/*.bin and images/camNN_FRAME.png of the first frame; cameras are renamed.

    The parser sorts images by name and holds out every N-th from the first on (`--test_every N`), so a held-out
    camera gets every N-th name. N is the number of all cameras divided by that of the held-out ones.
    """
    every = test_every(len(export.train_cameras), len(export.test_cameras))
    held_out, trained = list(export.test_cameras), list(export.train_cameras)
    total = len(held_out) + len(trained)
    ordered = [held_out.pop(0) if index % every == 0 else trained.pop(0) for index in range(total)]
    digits = max(2, len(str(total - 1)))
    names = {name: f"cam{index:0{digits}d}" for index, name in enumerate(ordered)}
    frame = export.recording.frames[0]
    export.write_images(
        lambda camera, _: export.folder / "images" / f"{names[camera]}_{frame:04d}.png", frames=(frame,)
    )
    images = [
        Image(f"{names[name]}_{frame:04d}.png", index + 1, export.recording.cameras[name])
        for index, name in enumerate(ordered)
    ]
    write_model(export.folder / "sparse" / "0", images, export.cloud)
    return export.written({name: names[name] for name in export.recording.cameras}, {frame: frame})


def test_every(trained: int, held_out: int) -> int:
    """N so that every N-th image from the first on is held out, and no other.

    Raises:
        D2Error: no N does that.
    """
    total = trained + held_out
    for every in range(total, 0, -1):
        if -(-total // every) == held_out:
            return every
    raise D2Error(
        f"gsplat's parser holds out every N-th image, the first at least, and no N gives {held_out} of {total}: "
        "name one camera with --test-cameras, or as many as are trained on"
    )
