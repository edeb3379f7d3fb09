"""What a player that somebody else wrote draws from our files: gsplat.js, an npm package, in a browser.

It is looked for in the folders of NODE_PATH: `npm install gsplat@1.2.9`.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import make_views
from viewing.chromium import browser, image
from viewing.export.scenes import DURATION, HEIGHT, WIDTH, make_scene, psnr, sharp_model

from d2_plugin.backbones.model import SplatModel
from d2_plugin.protocol import RasterSettings, View
from d2_plugin.rasterizer import rasterize
from d2_plugin.viewing.export.splatv import write_splatv

pytestmark = pytest.mark.browser

SITE = "http://player.test"
PLAYER = """<!DOCTYPE html><canvas id="c" width="%d" height="%d"></canvas><script type="module">
import * as SPLAT from "/index.es.js";
const canvas = document.getElementById("c");
const renderer = new SPLAT.WebGLRenderer(canvas), scene = new SPLAT.Scene(), camera = new SPLAT.Camera();
renderer.addProgram(new SPLAT.VideoRenderProgram(renderer));
renderer.setSize(%d, %d);
camera.data.fx = %f; camera.data.fy = %f;
const read = await SPLAT.SplatvLoader.LoadAsync("/scene.splatv", scene, camera, () => {});
const at = async (time) => {
  // Its clock is (1 + sin(seconds)) / 2 of the clip: no other way to stop it is left open.
  Date.now = () => 1000 * Math.asin(2 * time - 1);
  for (let i = 0; i < 40; i++) {
    renderer.render(scene, camera);
    await new Promise((resolve) => setTimeout(resolve, 25));
  }
  renderer.render(scene, camera);
  const black = document.createElement("canvas"), context = black.getContext("2d");
  [black.width, black.height] = [canvas.width, canvas.height];
  context.fillRect(0, 0, black.width, black.height);
  context.drawImage(canvas, 0, 0);
  return black.toDataURL("image/png");
};
window.player = { count: read.data.vertexCount, positions: () => Array.from(read.data.positions), at };
</script>"""


def package() -> Path:
    """gsplat.js as one module; skips the test, by name, where it is not installed."""
    for folder in filter(None, os.environ.get("NODE_PATH", "").split(os.pathsep)):
        path = Path(folder) / "gsplat" / "dist" / "index.es.js"
        if path.is_file():
            return path
    pytest.skip("the npm package gsplat (gsplat.js) is not installed where Node looks (NODE_PATH)")


def drawn(model: SplatModel, view: View) -> np.ndarray:
    """Our image by its rules: nothing is widened by a part of a pixel, and black lies behind."""
    with torch.no_grad():
        splats = model.slice_at(view)
        return rasterize(splats, model.colors(view, splats), view, RasterSettings(blur=0.0)).color.clamp(0, 1).numpy()


def test_gsplat_js_reads_and_draws_our_splatv(tmp_path: Path) -> None:
    module = package()
    model = sharp_model("yang4d", background=False)
    scene = make_scene(model)
    centred = [replace(camera, K=camera.K * [[1, 1, 0], [1, 1, 0], [1, 1, 1]]) for camera in scene.train_cameras]
    for camera in centred:
        camera.K[:2, 2] = WIDTH / 2, HEIGHT / 2  # it knows no other principal point
    path = tmp_path / "scene.splatv"
    write_splatv(path, scene.moving, DURATION, centred)
    focal = (centred[0].K[0, 0], centred[0].K[1, 1])
    page_text = PLAYER % (WIDTH, HEIGHT, WIDTH, HEIGHT, *focal)
    bodies = {"/": page_text.encode(), "/index.es.js": module.read_bytes(), "/scene.splatv": path.read_bytes()}
    kinds = {"/": "text/html", "/index.es.js": "text/javascript", "/scene.splatv": "application/octet-stream"}
    with browser(480, 360) as new:
        page = new()
        page.page.route(
            f"{SITE}/**",
            lambda route: route.fulfill(
                body=bodies[route.request.url.removeprefix(SITE)],
                content_type=kinds[route.request.url.removeprefix(SITE)],
            ),
        )
        page.open(SITE + "/")
        page.page.wait_for_function("window.player !== undefined")
        written = scene.moving.positions.float().numpy()
        positions = np.array(page.run("player.positions()"), np.float32).reshape(-1, 3)[: len(written)]
        # Column x of what it sorts by is a rotation (SplatvData.Deserialize of 1.2.9); these cameras look along z.
        np.testing.assert_array_equal(positions[:, 1:], written[:, 1:])
        view = make_views()[0]
        K = torch.tensor(centred[0].K, dtype=torch.float32)
        for time in (0.1, 0.42):
            theirs = image(page.run("(share) => player.at(share)", time / DURATION)) / 255
            here = View("left", 0, time, view.T_camera_world, K, WIDTH, HEIGHT)
            assert psnr(theirs, drawn(model, here)) > 35, f"{time} s: {psnr(theirs, drawn(model, here)):.1f} dB"
            other = View("left", 0, DURATION - time, view.T_camera_world, K, WIDTH, HEIGHT)
            assert psnr(theirs, drawn(model, other)) < psnr(theirs, drawn(model, here)) - 5
