"""A limb that turns about its joint, drawn at any angle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.priors.limbs import limbs
from d2_plugin.priors.scene_flow import Region, dense_flow, followed

cv2 = pytest.importorskip("cv2")
HEIGHT, WIDTH = 120, 200
JOINT, LENGTH = np.array([100.0, 60.0]), 42.0


def image(angle: float | None, shoulder: tuple[float, float] = (0.0, 0.0), scale: int = 1) -> np.ndarray:
    """A textured body before a wall; an arm hangs on it at an angle in degrees, light at its end."""
    noise = np.random.default_rng(0)
    wall = cv2.resize(noise.integers(90, 110, (15, 25, 3)).astype(np.uint8), (WIDTH, HEIGHT))
    if angle is None:
        return np.kron(wall, np.ones((scale, scale, 1), np.uint8))
    body = cv2.resize(noise.integers(20, 90, (12, 6, 3)).astype(np.uint8), (24, 60))
    wall[40:100, 80:104] = body
    joint = JOINT + shoulder
    way = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    for part, color in ((0.0, (220, 60, 60)), (0.55, (250, 200, 170))):
        ends = [tuple(round(16 * x) for x in joint + share * LENGTH * way) for share in (part, 1.0)]
        cv2.line(wall, *ends, color, 7, cv2.LINE_AA, 4)
    return np.kron(wall, np.ones((scale, scale, 1), np.uint8))


def found(earlier: np.ndarray, later: np.ndarray, still: np.ndarray) -> list[Region]:
    flows = dense_flow(earlier, later), dense_flow(later, earlier)
    follows = followed(earlier, later, *flows), followed(later, earlier, *flows[::-1])
    return limbs((earlier, later), still.astype(np.float32), flows, follows, [])


class TestLimbs:
    @pytest.mark.parametrize(("start", "end"), [(-35, 10), (10, -35), (-20, 25), (20, -40)])
    @pytest.mark.parametrize("scale", [1, 3])
    def test_an_arm_is_found_turning_from_both_ends_of_time(self, start: float, end: float, scale: int) -> None:
        matched = found(image(start, scale=scale), image(end, scale=scale), image(None, scale=scale))
        assert len(matched) == 2
        for limb in matched:
            assert np.degrees(limb.turn) == pytest.approx(end - start, abs=8)
            assert abs(limb.joint / scale - complex(*JOINT)) < 9

    def test_halfway_it_is_where_the_arm_is(self) -> None:
        matched = found(image(-35), image(10), image(None))
        true = np.abs(image(-12.5).astype(int) - image(None)).max(-1) > 60
        for limb in matched:
            for pixels, way in zip((limb.start, limb.end), limb.way(0.5)):
                rows, columns = np.unravel_index(pixels, limb.shape)
                column, row = np.rint(way.T + (columns, rows)).astype(int)
                assert true[row, column].mean() > 0.8

    def test_nothing_turns_that_stands_still_or_is_gone(self) -> None:
        assert found(image(10), image(10), image(None)) == []
        assert found(image(10), image(None), image(None)) == []
        assert found(image(None), image(None), image(None)) == []

    def test_what_is_matched_already_is_left_alone(self) -> None:
        earlier, later, still = image(-35), image(10), image(None)
        flows = dense_flow(earlier, later), dense_flow(later, earlier)
        everything = np.arange(HEIGHT * WIDTH)
        known = [Region(everything, everything, np.zeros(2), 0.0, (HEIGHT, WIDTH))]
        follows = followed(earlier, later, *flows), followed(later, earlier, *flows[::-1])
        assert limbs((earlier, later), still.astype(np.float32), flows, follows, known) == []


class TestWay:
    @settings(max_examples=50)
    @given(st.floats(-3, 3), st.tuples(st.floats(-30, 30), st.floats(-30, 30)), st.floats(0, 1))
    def test_both_ends_of_a_way_meet_at_any_time(self, turn: float, shift: tuple[float, float], part: float) -> None:
        """A pixel and where it lands are at one place, whatever part of the time has passed."""
        joint, start = 50 + 40j, np.array([70 + 44j, 50 + 40j, 20 + 90j])
        there = (start - joint) * np.exp(1j * turn) + joint + complex(*shift)
        shape, (columns, rows) = (
            (200, 200),
            (np.rint(there.real).astype(int) + 60, np.rint(there.imag).astype(int) + 60),
        )
        end = np.ravel_multi_index((np.clip(rows, 0, 199), np.clip(columns, 0, 199)), shape)
        region = Region(np.zeros(1, int), end, np.array(shift), 0.0, shape, turn, joint)
        np.testing.assert_allclose(region.path(start, 0.0), start, atol=1e-9)
        np.testing.assert_allclose(region.path(start, 1.0), there, atol=1e-9)
        np.testing.assert_allclose(region.way(1.0)[1], 0, atol=1e-9)
        landed = np.clip(columns, 0, 199) + 1j * np.clip(rows, 0, 199)
        began = landed + region.way(0.0)[1].copy().view(complex)[:, 0]
        here = landed + region.way(part)[1].copy().view(complex)[:, 0]
        np.testing.assert_allclose(region.path(began, part), here, atol=1e-9)
