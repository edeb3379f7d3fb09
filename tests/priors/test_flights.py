"""Things that fly past several cameras: placed without depth, followed through gaps, on one parabola."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from d2_plugin.priors.flights import Observation, Passage, common_acceleration, join, link, passages
from d2_plugin.priors.geometry import projected
from d2_plugin.recordings.recording import Camera

FALL = np.array([0.0, 0.4, 0.0])
UNKNOWN = np.full(2, np.nan)


def camera(x: float, turned: float = 0.0) -> Camera:
    """At (x, 0, -4), looking along z, turned about the vertical."""
    c, s = np.cos(turned), np.sin(turned)
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    pose[:3, 3] = -pose[:3, :3] @ [x, 0, -4.0]
    return Camera(f"{x}", 320, 180, np.array([[200.0, 0, 160], [0, 200, 90], [0, 0, 1]]), pose)


RIG = [camera(-1.5, 0.35), camera(0.0), camera(1.5, -0.35)]


def observations(*ways: np.ndarray, cameras: list[int] | None = None, depth: bool = False) -> list[Observation]:
    """What cameras of the rig see of balls of radius .1 that go over some ways [2, 3]."""
    seen = []
    for which in range(len(RIG)) if cameras is None else cameras:
        for number, ends in enumerate(ways):
            pixels, depths, _ = projected(RIG[which], ends)
            seen.append(Observation(which, number, pixels, 0.1 * 200 / depths[0], depths if depth else UNKNOWN))
    return seen


def thrown(count: int, bounce: int | None = None) -> list[list[Passage]]:
    """A body that falls, from interval to interval; it goes up again at the start of one."""
    place, speed, intervals = np.array([-0.5, 0.0, 0.0]), np.array([0.1, -0.3, 0.2]), []
    for index in range(count):
        if index == bounce:
            speed = speed * (1, -1, 1)
        over = speed + FALL / 2
        intervals.append([Passage(np.array([place, place + over]), 0.1, observations(np.array([place, place + over])))])
        place, speed = place + over, speed + FALL
    link(intervals)
    return intervals


coordinate = st.floats(-0.6, 0.6)
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)


class TestPlaces:
    @given(point, point)
    def test_rays_of_two_cameras_place_a_thing_exactly_without_any_depth(
        self, start: np.ndarray, end: np.ndarray
    ) -> None:
        found = passages(RIG, observations(np.array([start, end])))
        assert [len(passage.observations) for passage in found] == [3]
        np.testing.assert_allclose(found[0].ends, [start, end], atol=1e-9)
        assert found[0].radius == pytest.approx(0.1, rel=1e-6)

    def test_each_of_two_things_is_found_once_whoever_sees_them(self) -> None:
        ways = np.array([[-0.5, 0, 0], [-0.2, 0.1, 0]]), np.array([[0.5, -0.3, 0.5], [0.5, 0.2, 0.5]])
        found = passages(RIG, [*observations(ways[0], cameras=[0, 2]), *observations(ways[1], cameras=[0, 1])])
        assert sorted(
            tuple(sorted(observation.camera for observation in passage.observations)) for passage in found
        ) == [(0, 1), (0, 2)]
        for passage, truth in zip(sorted(found, key=lambda one: one.ends[0][0]), ways):
            np.testing.assert_allclose(passage.ends, truth, atol=1e-9)

    def test_one_camera_places_it_by_its_depth_and_not_at_all_without(self) -> None:
        truth = np.array([[-0.5, 0, 0], [-0.2, 0.1, 0]])
        found = passages(RIG, observations(truth, cameras=[1], depth=True))
        np.testing.assert_allclose(found[0].ends, truth, atol=1e-9)
        assert passages(RIG, observations(truth, cameras=[1])) == []
        assert passages(RIG, []) == []

    def test_regions_that_no_one_thing_explains_are_no_thing(self) -> None:
        one, other = np.array([[-0.5, 0, 0], [-0.2, 0.1, 0]]), np.array([[0.5, -0.5, 0.5], [0.5, 0.2, 0.5]])
        assert passages(RIG, [*observations(one, cameras=[0]), *observations(other, cameras=[1])]) == []

    def test_rays_that_are_all_but_parallel_or_meet_behind_a_camera_place_nothing(self) -> None:
        beside = [camera(0.0), camera(1e-4)]
        truth = np.array([[0.0, 0, 0], [0.3, 0, 0]])
        seen = [Observation(which, 0, projected(view, truth)[0], 5.0, UNKNOWN) for which, view in enumerate(beside)]
        assert passages(beside, seen) == []
        crossed = [seen[0], seen[1]._replace(ends=seen[1].ends + (40.0, 0))]  # they meet behind both
        assert passages([camera(0.0), camera(1.0)], crossed) == []


class TestFall:
    def test_what_falls_agrees_on_its_acceleration_whatever_else_moves(self) -> None:
        noise = np.random.default_rng(0)
        intervals = thrown(7)
        for index in range(0, 6, 2):
            ways = noise.normal(size=(3, 3))
            one, other = (Passage(ways[i : i + 2], 0.1, [intervals[0][0].observations[0]]) for i in (0, 1))
            join(one, other)
            intervals[index].append(one)
        np.testing.assert_allclose(common_acceleration(intervals), FALL, atol=1e-9)

    def test_what_does_not_agree_or_is_seen_too_seldom_does_not_fall(self) -> None:
        noise, intervals = np.random.default_rng(0), []
        for _ in range(20):
            ways = noise.normal(size=(3, 3))
            one, other = (Passage(ways[i : i + 2], 0.1, thrown(1)[0][0].observations[:1]) for i in (0, 1))
            join(one, other)
            intervals.append([one, other])
        assert common_acceleration(intervals) is None
        assert common_acceleration(thrown(3)) is None
        assert common_acceleration([]) is None

    def test_pairs_of_hundreds_of_flights_do_not_fill_the_memory(self) -> None:
        intervals = thrown(600)
        tracemalloc.start()
        np.testing.assert_allclose(common_acceleration(intervals), FALL, atol=1e-6)
        assert tracemalloc.get_traced_memory()[1] < 5e6
        tracemalloc.stop()

    def test_a_flight_goes_on_beyond_both_of_its_ends_as_it_flew(self) -> None:
        one, two, three = (each[0] for each in thrown(3))
        np.testing.assert_allclose(two.beyond(1, FALL).ends, three.ends, atol=1e-12)
        np.testing.assert_allclose(two.beyond(-1, FALL).ends, one.ends, atol=1e-12)

    def test_it_flies_before_and_after_it_hits_something_and_what_is_held_does_not(self) -> None:
        assert all(each[0].flies(FALL) for each in thrown(5, bounce=2))
        steady = [[Passage(np.array([[0.3 * i, 0, 0], [0.3 * i + 0.3, 0, 0]]), 0.1)] for i in range(4)]
        link(steady)
        assert steady[1][0].before is steady[0][0]
        assert not any(each[0].flies(FALL) for each in steady)
        assert not Passage(np.zeros((2, 3)), 0.1).flies(FALL)

    @pytest.mark.parametrize("part", [0.25, 0.5, 0.75])
    def test_between_it_is_on_its_parabola(self, part: float) -> None:
        flight = thrown(3)[1][0]
        speed = flight.over - FALL / 2
        np.testing.assert_allclose(
            flight.where(part, FALL), flight.ends[0] + part * speed + FALL * part**2 / 2, atol=1e-12
        )

    @pytest.mark.parametrize("impact", [0.25, 0.4, 0.6, 0.75])
    def test_where_it_hits_something_it_has_turned_by_then_or_not(self, impact: float) -> None:
        """It falls with 1, and goes up again with 1, `impact` of an interval after the start."""

        def height(t: float) -> float:
            since, speed = t - impact, 1.0 if t > impact else -1.0
            return -(speed * since) + FALL[1] * since**2 / 2

        places = [np.array([0.0, height(t), 0.0]) for t in (-1, 0, 1, 2)]
        way = [Passage(np.array(places[i : i + 2]), 0.1) for i in range(3)]
        join(way[0], way[1])
        join(way[1], way[2])
        np.testing.assert_allclose(way[1].where(0.5, FALL)[1], height(0.5), atol=1e-9)
