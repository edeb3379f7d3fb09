"""Every compiled kernel of the priors returns what its NumPy oracle does, for any number of threads."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import cross_view as cross_view_oracle
from oracles import stereo_filter as oracle
from prior_cases import camera_at, plane_seen_by

from d2_plugin.compiler import NoCompiler
from d2_plugin.errors import D2Error
from d2_plugin.priors import build
from d2_plugin.priors.evidence import with_evidence
from d2_plugin.priors.stereo.filtering import confirm, kernel, precision
from d2_plugin.priors.stereo.filtering.filter import surface_coherence
from d2_plugin.priors.stereo.geometric_depth import gray
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.protocol import Label
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.maps import FusedPrior

pytest.importorskip("cv2")
pytestmark = pytest.mark.usefixtures("compiler")
SETTINGS = StereoSettings()
TOLERANCE = 0.02
Rig = tuple[list[np.ndarray], list[Camera], list[np.ndarray]]
"""Grey images, cameras, depth maps."""
Maps = dict[str, np.ndarray]


def assert_is_the_oracle(compiled: Callable[..., list[np.ndarray]], *given: object) -> None:
    """What the kernels of stereo depth return has the bits of what NumPy does in their place."""
    ours = compiled(*given)
    with pytest.MonkeyPatch.context() as patch, np.errstate(all="ignore"):  # of pixels that are masked afterwards
        patch.setattr(kernel, "run", oracle.run)
        patch.setattr(confirm, "confirm", oracle.confirm)
        theirs = compiled(*given)
    for one, other in zip(ours, theirs, strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


class TestStereoFilter:
    """Coherence and confirmation of stereo depth, bit for bit."""

    @staticmethod
    def rig(count: int, width: int, height: int, unit: float, noise: float, seed: int) -> Rig:
        """Cameras side by side before a wall three units away, noisy and with holes."""
        random, shape = np.random.default_rng(seed), (height, width)
        places = [unit * np.array([0.5 * i, *random.normal(0, 0.1, 2)]) for i in range(count)]
        cameras = [camera_at(place, random.normal(0, 0.05), size=(width, height)) for place in places]
        depths = [unit * 3 * np.exp(random.normal(0, noise, shape)) for _ in range(count)]
        depths = [np.where(random.random(shape) < 0.9, depth, 0).astype(np.float32) for depth in depths]
        return [random.integers(100, 130, shape).astype(np.uint8) for _ in range(count)], cameras, depths

    @staticmethod
    def compiled(rig: Rig, chosen: StereoSettings = SETTINGS) -> list[np.ndarray]:
        """Coherence of every view, then what confirms each."""
        grays, cameras, depths = rig
        shares = [surface_coherence(*pair) for pair in zip(grays, depths)]
        return shares + [map_ for i in range(len(cameras)) for map_ in confirm.confirm(i, cameras, depths, chosen)]

    @settings(max_examples=30, deadline=None)
    @given(
        count=st.integers(2, 4),
        width=st.integers(1, 70),
        height=st.integers(1, 40),
        exponent=st.integers(-8, 8),
        noise=st.sampled_from([0.0, 1e-3, 0.02, 1.0]),
        between=st.booleans(),
        seed=st.integers(0, 1000),
    )
    def test_is_the_bits_of_the_oracle(self, count, width, height, exponent, noise, between, seed) -> None:
        rig = self.rig(count, width, height, 10.0**exponent, noise, seed)
        assert_is_the_oracle(self.compiled, rig, replace(SETTINGS, between_pixels=between))

    def test_is_the_bits_of_the_oracle_on_a_recording(self, shared_data: Callable[[str], Path]) -> None:
        recording, chosen = open_recording(shared_data("plaza")), ("00", "02", "05")
        grays = [gray(recording.image(camera, 5)) for camera in chosen]
        noise, truths = np.random.default_rng(0), [recording.depth(camera, 5) for camera in chosen]
        depths = [truth * noise.lognormal(0, 0.01, truth.shape).astype(np.float32) for truth in truths]
        assert_is_the_oracle(self.compiled, (grays, [recording.cameras[camera] for camera in chosen], depths))

    def test_does_not_depend_on_threads(self, same_for_any_threads: Callable) -> None:
        same_for_any_threads(lambda: self.compiled(self.rig(3, 61, 43, 1.0, 1e-3, 1)))

    def test_does_not_depend_on_the_unit_of_the_world(self) -> None:
        """Cross products of float32 coordinates would end at 1e9 of a unit, and below 1e-10 of one."""
        rigs = [self.rig(3, 60, 40, unit, 1e-3, 0) for unit in (2.0**-40, 1.0, 2.0**40)]
        small, plain, large = ([confirm.confirm(i, *rig[1:], SETTINGS).sources for i in range(3)] for rig in rigs)
        assert np.mean(plain) > 0.4
        np.testing.assert_array_equal(small, plain)
        np.testing.assert_array_equal(large, plain)

    @pytest.mark.parametrize("limits", [(0.0, 180.0), (0.5, 5.0), (29.9, 30.1), (79.0, 90.0)])
    def test_rays_meet_between_the_limits(self, limits: tuple[float, float]) -> None:
        """Two cameras that look along z, side by side: the second one's ray to the middle has a known angle."""
        size, depths = 41, [np.full((41, 41), 3.0, np.float32)] * 2
        chosen = StereoSettings(min_angle=limits[0], max_angle=limits[1], between_pixels=False)
        for degrees in (0.3, 1.0, 4.0, 30.0, 80.0):
            slope = np.tan(np.deg2rad(degrees))
            pair = [camera_at((3 * s, 0, 0), size=(size, size), principal=(0.5 + s, 0.5)) for s in (0, slope)]
            met = confirm.confirm(0, pair, depths, chosen).sources[20, 20]
            assert met == (limits[0] < degrees < limits[1]), degrees


class TestPrecision:
    """Sigma of stereo depth and the scatter about the plane of its window, bit for bit."""

    @staticmethod
    def maps(width: int, height: int, unit: float, noise: float, known: float, seed: int) -> Maps:
        """A slanted plane, noisy and with holes, and what is known of it; some NaN, infinite or out of range."""
        random = np.random.default_rng(seed)
        v, u = np.mgrid[:height, :width]
        depth = unit / (0.2 + 0.1 * u / width + 0.05 * v / height) * np.exp(random.normal(0, noise, (height, width)))
        limits = {"coherence": 1.0, "parallax": 300.0, "spread": 0.02, "gradient": 0.1}
        drawn = {name: high * random.random(depth.shape) for name, high in limits.items()}
        drawn["depth"] = np.where(random.random(depth.shape) < known, depth, 0)
        odd = [0.0, -1.0, np.nan, np.inf, -np.inf, 7.0]
        return {
            name: np.where(random.random(depth.shape) < 0.05, random.choice(odd, depth.shape), map_).astype(
                np.float64 if name in ("parallax", "spread") else np.float32
            )
            for name, map_ in drawn.items()
        }

    @staticmethod
    def compiled(maps: Maps, window: int = precision.WINDOW) -> tuple[np.ndarray, np.ndarray]:
        """(sigma, scatter)."""
        with np.errstate(all="ignore"):
            depth = np.where(np.isfinite(maps["depth"]), maps["depth"], 0)
            return precision.geometric_sigma(**maps), precision.plane_scatter(depth, window)

    @settings(max_examples=40, deadline=None)
    @given(
        width=st.integers(1, 70),
        height=st.integers(1, 40),
        exponent=st.integers(-6, 6),
        noise=st.sampled_from([0.0, 1e-3, 0.02, 3.0]),
        known=st.sampled_from([0.1, 0.9, 1.0]),
        window=st.sampled_from([1, 3, 7, 9]),
        seed=st.integers(0, 1000),
    )
    def test_is_the_bits_of_the_oracle(self, width, height, exponent, noise, known, window, seed) -> None:
        assert_is_the_oracle(self.compiled, self.maps(width, height, 10.0**exponent, noise, known, seed), window)

    @pytest.mark.parametrize("value", [1e-45, 1e-38, 1e-6, 1e6, 3e38, 0.0, -1.0, np.nan, np.inf])
    @pytest.mark.parametrize("name", ["depth", "coherence", "parallax", "spread", "gradient"])
    def test_is_the_bits_of_the_oracle_at_extremes(self, name: str, value: float) -> None:
        maps = self.maps(30, 20, 1.0, 1e-3, 0.9, 0)
        maps[name][::2, ::3] = value
        assert_is_the_oracle(self.compiled, maps)
        assert not np.isnan(self.compiled(maps)[0]).any()

    def test_does_not_depend_on_threads(self, same_for_any_threads: Callable) -> None:
        same_for_any_threads(lambda: self.compiled(self.maps(61, 43, 1.0, 1e-3, 0.9, 1)))


class TestCrossView:
    """Labels bit for bit; depth and sigma but for the last digit, which logarithms of two libraries may turn."""

    @staticmethod
    def rig(sizes: list[tuple[int, int]], unit: float, noise: float, colored: bool, seed: int):
        """Views of one wall: maps that differ, surfaces, holes, infinite sigmas, images of different brightness."""
        random, priors, cameras = np.random.default_rng(seed), {}, {}
        for index, (width, height) in enumerate(sizes):
            place, angle = unit * random.normal(0, 0.3, 3), random.normal(0, 0.1)
            view = camera_at(place, angle, size=(width, height), principal=tuple(random.normal(0.5, 0.1, 2)))
            shape, truth = (height, width), plane_seen_by(view, (0, 0, 1), 3 * unit)
            verified = random.random((height // 8 + 1, width // 8 + 1)).repeat(8, 0).repeat(8, 1)[:height, :width] < 0.6
            depth = truth * np.exp(np.where(verified, 0, random.normal(0, noise) + random.normal(0, noise / 9, shape)))
            labels = np.where(verified, Label.VERIFIED, Label.MONO)
            labels = np.where(random.random(shape) < 0.1, random.integers(0, len(Label), shape), labels)
            labels = np.where(depth > 0, labels, Label.EMPTY)
            sigma = np.where(verified, 0.001, random.choice([0.01, 0.1, np.inf], shape))
            colors = np.clip(random.normal(90 + 20 * index, 3, (*shape, 3)), 0, 255) if colored else None
            maps = depth.astype(np.float32), labels.astype(np.uint8), sigma.astype(np.float32)
            priors[str(index)] = FusedPrior(*maps, None if colors is None else colors.astype(np.uint8))
            cameras[str(index)] = view
        return priors, cameras

    def assert_is_the_oracle(self, priors, cameras, tails: Mapping[str, float] | None = None) -> None:
        with np.errstate(all="ignore"):
            compiled = with_evidence(priors, cameras, TOLERANCE, tails)
            expected = cross_view_oracle.with_evidence(priors, cameras, TOLERANCE, tails)
        for name, ours in compiled.items():
            np.testing.assert_array_equal(ours.labels, expected[name].labels)
            np.testing.assert_allclose(ours.depth, expected[name].depth, rtol=1e-6)
            np.testing.assert_allclose(ours.sigma, expected[name].sigma, rtol=1e-6)
            assert (ours.depth.dtype, ours.sigma.dtype) == (np.float32, np.float32)

    @settings(max_examples=40, deadline=None)
    @given(
        sizes=st.lists(st.tuples(st.integers(1, 70), st.integers(1, 40)), min_size=2, max_size=4),
        exponent=st.integers(-6, 6),
        noise=st.sampled_from([0.0, 0.01, 0.05, 1.0]),
        colored=st.booleans(),
        seed=st.integers(0, 1000),
    )
    def test_is_the_oracle(self, sizes, exponent, noise, colored, seed) -> None:
        rig = self.rig(sizes, 10.0**exponent, noise, colored, seed)
        self.assert_is_the_oracle(*rig, {"0": 2.0, "1": float("nan")})

    @pytest.mark.parametrize("value", [0.0, 1e-45, 1e-6, 1e6, 3e38, np.inf, -1.0, np.nan])
    @pytest.mark.parametrize("map_", ["depth", "sigma"])
    def test_is_the_oracle_on_numbers_that_no_prior_should_hold(self, map_: str, value: float) -> None:
        priors, cameras = self.rig([(40, 30)] * 3, 1.0, 0.02, True, 2)
        for prior in priors.values():
            getattr(prior, map_)[::3, 1::2] = value
        self.assert_is_the_oracle(priors, cameras)

    @pytest.mark.parametrize(
        "place",
        [(0.0, 0.0, 0.0), (0.0, 0.0, 3.0), (0.0, 0.0, 5.0), (1e12, 0.0, 0.0)],
        ids=["on one spot", "at the wall", "behind the wall", "far away"],
    )
    @pytest.mark.parametrize("turned", [0.0, np.pi / 2, np.pi])
    @pytest.mark.parametrize("principal", [(0.5, 0.5), (-2.0, 9.0)])
    def test_is_the_oracle_wherever_the_other_camera_stands(self, place, turned, principal) -> None:
        priors, cameras = self.rig([(40, 30)] * 2, 1.0, 0.02, True, 3)
        cameras["0"] = camera_at(size=(40, 30))
        cameras["1"] = camera_at(place, turned, size=(40, 30), principal=principal)
        self.assert_is_the_oracle(priors, cameras)

    def test_does_not_depend_on_threads(self, same_for_any_threads: Callable) -> None:
        rig = self.rig([(61, 43)] * 4, 1.0, 0.02, True, 1)

        def maps() -> list[np.ndarray]:
            changed = with_evidence(*rig, TOLERANCE).values()
            return [map_ for prior in changed for map_ in (prior.labels, prior.depth, prior.sigma)]

        same_for_any_threads(maps)


def test_without_a_compiler_one_sentence_says_so_before_anything_is_built(tmp_path: Path, monkeypatch) -> None:
    def none() -> None:
        raise NoCompiler("no C++ compiler found (looked for CXX, c++, g++, clang++): install g++ or clang++")

    monkeypatch.setattr(build.filtering, "library", none)
    room = synthetic_recording(cameras=2, held_out=0, frames=1, width=32, height=24)
    with pytest.raises(D2Error, match=r"compiled kernels.*a platform wheel.*no C\+\+ compiler found.*install g\+\+"):
        build.build_priors(room, list(room.cameras), tmp_path / "priors", build.PriorSettings())
    assert not (tmp_path / "priors").exists()
