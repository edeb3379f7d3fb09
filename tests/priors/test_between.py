"""Scene flow and the instants halfway, in a recording of flat things whose truth halfway is drawn as well."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from prior_cases import camera_at, showing

from d2_plugin.priors.between import build_between
from d2_plugin.priors.scene_flow import Region, dense_flow, followed, foreground, led_region, regions
from d2_plugin.priors.sheet import contact_sheet
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Recording, Source
from d2_plugin.store.exported import RenamedStore
from d2_plugin.store.maps import FusedPrior
from d2_plugin.store.store import QUARTERS, PriorStore

cv2 = pytest.importorskip("cv2")
HEIGHT, WIDTH, FOCAL = 72, 192, 100.0
RADIUS, BALL_DEPTH, WALL_DEPTH = 6, 2.0, 4.0
FALL = np.array([0.0, 0.4, 0.0])
"""World units per interval squared: 20 pixels at the ball's depth."""


def wall() -> np.ndarray:
    """A wall with a texture, RGB [H, W, 3]."""
    noise = np.random.default_rng(0).integers(60, 140, (HEIGHT // 4, WIDTH // 4, 3)).astype(np.uint8)
    return cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def ball(column: float, row: float, radius: float = RADIUS) -> np.ndarray:
    """Its pixels [H, W]."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return (columns - column) ** 2 + (rows - row) ** 2 < radius**2


def shown(*balls: np.ndarray) -> np.ndarray:
    image = wall()
    for mask in balls:
        image[mask] = (240, 150, 20)
    return image


def way(instant: float) -> tuple[float, float]:
    """Column and row of a ball thrown at instant 0, in a camera at the origin."""
    position = np.array([-0.9, 0.5, BALL_DEPTH]) + instant * np.array([0.4, -0.85, 0]) + FALL * instant**2 / 2
    return tuple(FOCAL * position[:2] / BALL_DEPTH + np.array([WIDTH, HEIGHT]) / 2 - 0.5)


def thrown(
    path: Path, count: int, cameras: int = 1, changes: dict[int, np.ndarray] | None = None, aside: int = 0
) -> PriorStore:
    """Finished priors of cameras in one place; `changes` are other images by frame, all of the last is `aside`."""
    store = PriorStore.create(path, [f"cam{index}" for index in range(cameras)], range(count), {"recording": "thrown"})
    camera = {"K": [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], "T_camera_world": np.eye(4).tolist()}
    for name, frame in itertools.product(store.cameras, store.frames):
        left = aside if name == store.cameras[-1] else 0
        camera["K"][0][2] = WIDTH / 2 - left
        mask = ball(way(frame)[0] - left, way(frame)[1])
        prior = FusedPrior(
            np.where(mask, BALL_DEPTH, WALL_DEPTH).astype(np.float32),
            np.full((HEIGHT, WIDTH), Label.VERIFIED, np.uint8),
            np.full((HEIGHT, WIDTH), 0.01, np.float32),
            (changes or {}).get(frame, shown(mask)),
        )
        about = {"key": f"{name} {frame}", "camera": camera, "shares": prior.shares(), "refused": "", "monocular": ""}
        store.write(name, frame, prior, about)
    return store


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> PriorStore:
    """Five instants and what lies between them, to be read only."""
    store = thrown(tmp_path_factory.mktemp("flown"), 5, 2)
    assert build_between(store) == 8
    return store


class TestForeground:
    def test_it_is_the_pixels_that_differ_and_no_specks(self) -> None:
        """An opening by a square of two pixels moved it by one."""
        thing, speck = ball(30, 40), np.zeros((HEIGHT, WIDTH), bool)
        speck[10, 100:110] = True
        np.testing.assert_array_equal(foreground(shown(thing, speck), wall().astype(np.float32)), thing)


class TestRegions:
    start, end = ball(30, 40), ball(62, 30)
    images = shown(start), shown(end)

    def matched(self, earlier: np.ndarray, later: np.ndarray) -> list[np.ndarray]:
        flows = dense_flow(earlier, later), dense_flow(later, earlier)
        return [region.shift for region in regions(earlier, later, wall().astype(np.float32), *flows)]

    def test_a_ball_that_flow_loses_is_matched_whole_in_both_directions_of_time(self) -> None:
        images = self.images
        assert not followed(*images, dense_flow(*images), dense_flow(*images[::-1]))[self.start].all()
        for shift, pair in (((32, -10), images), ((-32, 10), images[::-1])):
            matched = self.matched(*pair)
            assert matched
            assert all(np.abs(one - shift).max() <= 1 for one in matched)

    def test_an_image_four_times_as_wide_is_searched_in_a_small_one_and_gives_its_own_pixels(self) -> None:
        earlier, later, still = (np.kron(image, np.ones((4, 4, 1), np.uint8)) for image in (*self.images, wall()))
        flows = dense_flow(earlier, later), dense_flow(later, earlier)
        matched = regions(earlier, later, still.astype(np.float32), *flows)
        assert matched
        assert all(np.abs(region.shift - (128, -40)).max() <= 1 for region in matched)

    def test_nothing_is_matched_that_does_not_move_or_is_there_at_one_instant_only(self) -> None:
        alone, nothing = shown(self.start), shown()
        assert not any(self.matched(*pair) for pair in ((alone, alone), (alone, nothing), (nothing, alone)))

    def test_of_two_each_goes_its_own_way(self) -> None:
        matched = self.matched(shown(self.start, ball(130, 55, 10)), shown(self.end, ball(100, 57, 10)))
        assert {tuple(np.round(shift, -1)) for shift in matched} == {(30, -10), (-30, 0)}

    def test_what_is_half_hidden_at_the_end_is_matched_or_left_out(self) -> None:
        hidden = self.end & (np.mgrid[:HEIGHT, :WIDTH][1] < 62)
        # Half a disc of one colour fits within the whole one wherever its rim does not say otherwise.
        assert all(np.abs(shift - (32, -10)).max() <= 4 for shift in self.matched(shown(self.start), shown(hidden)))

    @pytest.mark.parametrize("size", [(1, 1), (5, 300), (30, 4000)])
    def test_images_that_are_small_or_flat_are_followed_too(self, size: tuple[int, int]) -> None:
        earlier, later = np.random.default_rng(0).integers(0, 255, (2, *size, 3), np.uint8)
        flow = dense_flow(earlier, later)
        assert flow.shape == (*size, 2)
        assert np.isfinite(flow).all()
        regions(earlier, later, earlier.astype(np.float32), flow, -flow)


class TestLed:
    """A thing is looked for where other cameras see it go."""

    still = wall().astype(np.float32)
    radii = np.array([RADIUS, RADIUS])

    def led(self, earlier: np.ndarray, later: np.ndarray, *ends: tuple[float, float]) -> Region | None:
        return led_region(earlier, later, self.still, np.array(ends) + 0.5, self.radii)

    @pytest.mark.parametrize("off", [(0, 0), (2, -1), (-1, 2)])
    def test_it_is_found_to_the_pixel_though_it_is_said_to_be_a_little_beside(self, off: tuple[int, int]) -> None:
        end = 62 + off[0], 30 + off[1]
        region = self.led(shown(ball(30, 40)), shown(ball(62, 30)), (30, 40), end)
        np.testing.assert_array_equal(region.shift, (32, -10))
        assert ball(30, 40).flat[region.start].all()
        assert ball(62, 30, RADIUS + 1).flat[region.end].all()

    def test_it_is_not_where_the_images_do_not_show_it(self) -> None:
        both, nothing = shown(ball(30, 40)), shown()
        assert self.led(both, nothing, (30, 40), (62, 30)) is None
        assert self.led(nothing, shown(ball(62, 30)), (30, 40), (62, 30)) is None
        assert self.led(nothing, nothing, (30, 40), (62, 30)) is None
        assert self.led(both, both, (-50, 40), (-90, 30)) is None  # outside of the image all the time

    def test_where_it_comes_into_the_image_the_later_instant_alone_shows_it(self) -> None:
        region = self.led(shown(), shown(ball(20, 30)), (-30, 50), (20, 30))
        assert len(region.start) == 0
        np.testing.assert_array_equal(region.shift, (50, -20))
        np.testing.assert_array_equal(region.end, np.flatnonzero(ball(20, 30)))
        assert len(self.led(shown(ball(20, 30)), shown(), (20, 30), (-30, 50)).end) == 0


class TestHalfway:
    def test_a_thrown_ball_is_on_its_parabola_with_its_depth_and_nothing_is_there_twice(self, flown) -> None:
        for frame, quarter in itertools.product(range(4), QUARTERS):
            following, halfway = flown.underway("cam1", frame, quarter)
            assert following == frame + 1
            inner, around = (ball(*way(frame + quarter / 4), RADIUS + by) for by in (-2, 2))
            image, depth = halfway.colors.numpy().astype(int), halfway.depth.numpy()
            assert np.abs(image[inner] - (240, 150, 20)).max() < 20
            assert np.median(np.abs(image - wall())[~around]) == 0
            twice = (image[..., 0] - image[..., 2] > 120) & ~around & (halfway.labels.numpy() != Label.CONFLICT)
            assert twice.sum() < 0.1 * around.sum()
            assert np.isclose(depth[inner], BALL_DEPTH, rtol=1e-3).mean() > 0.9
            np.testing.assert_array_equal(depth > 0, np.isin(halfway.labels, (Label.VERIFIED,)))

    def test_a_ball_that_comes_into_an_image_is_where_two_other_cameras_see_it(self, tmp_path: Path) -> None:
        store = thrown(tmp_path, 5, 3, aside=62)
        build_between(store)
        halfway = store.underway("cam2", 0, 3)[1]
        column, row = way(0.75)
        inner = ball(column - 62, row, RADIUS - 2)
        assert inner.sum() > 40
        assert np.abs(halfway.colors.numpy().astype(int)[inner] - (240, 150, 20)).max() < 20
        assert (halfway.labels.numpy()[inner] == Label.VERIFIED).all()

    def test_what_speeds_up_is_on_a_curve(self, tmp_path: Path) -> None:
        """A wide thing that speeds up: flow follows it, and its image halfway lies behind the middle."""
        band = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (HEIGHT, 60, 3)).astype(np.uint8), (0, 0), 2)

        def at(instant: float) -> np.ndarray:
            image, left = wall().astype(np.float32), 60 + 6 * instant**2 / 2
            shifted = cv2.warpAffine(band, np.array([[1, 0, left], [0, 1, 0]]), (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
            covered = slice(int(np.ceil(left)), int(np.floor(left)) + 59)
            image[:, covered] = shifted[:, covered]
            return image.astype(np.uint8)

        store = thrown(tmp_path, 4, changes={frame: at(frame) for frame in range(4)})
        build_between(store)
        inner = slice(75, 115)
        halfway = store.underway("cam0", 1, 2)[1].colors.numpy().astype(int)
        on_a_curve, in_the_middle = (np.abs(halfway - at(t))[:, inner].mean() for t in (1.5, np.sqrt(2.5)))
        assert on_a_curve < 0.5 * in_the_middle

    def test_a_network_of_flow_takes_the_place_of_dense_flow(self, tmp_path: Path) -> None:
        """A bar that turns about its middle by more than what OpenCV's flow, or a limb, follows."""
        bar = np.repeat(np.linspace(0, 255, 60)[None, :, None], 12, 0).repeat(3, 2).astype(np.uint8)
        middle, turn = np.array([WIDTH / 2, HEIGHT / 2]), np.radians(60)

        def matrix(instant: float) -> np.ndarray:
            angle = turn * instant
            turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            return np.column_stack([turned, middle - turned @ (30, 6)])

        def at(instant: float) -> tuple[np.ndarray, np.ndarray]:
            size = (WIDTH, HEIGHT)
            covered = cv2.warpAffine(np.ones((12, 60), np.uint8), matrix(instant), size, flags=cv2.INTER_NEAREST) > 0
            image = np.where(covered[..., None], cv2.warpAffine(bar, matrix(instant), size), wall())
            return image, covered

        class TrueFlow:
            fingerprint = "true"

            def kept(self, entries, camera: str, frame: int, image: np.ndarray, other: np.ndarray) -> np.ndarray:
                step = 1 if entries.path.name == "on" else -1
                angle, places = turn * step, np.indices((HEIGHT, WIDTH))[::-1].transpose(1, 2, 0) - middle
                turned = places @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
                return ((turned - places) * at(frame)[1][..., None]).astype(np.float32)

        errors = []
        for network in (None, TrueFlow()):
            store = thrown(tmp_path / str(network is None), 3, changes={frame: at(frame)[0] for frame in range(3)})
            assert build_between(store, network=network) == 2
            assert build_between(store, network=network) == 0
            halfway, (truth, covered) = store.underway("cam0", 0, 2)[1], at(0.5)
            inner = cv2.erode(covered.astype(np.uint8), np.ones((5, 5))) > 0
            errors.append(np.abs(halfway.colors.numpy().astype(int) - truth)[inner].mean())
        assert (halfway.labels.numpy() != Label.CONFLICT)[inner].mean() > 0.9
        assert errors[1] < 0.3 * errors[0]
        assert build_between(store) == 2  # by other flow

    def test_where_nothing_moves_it_is_the_image_and_no_depth_is_proposed(self, tmp_path: Path) -> None:
        store = thrown(tmp_path, 3, changes={frame: shown() for frame in range(3)})
        build_between(store)
        halfway = store.underway("cam0", 0, 2)[1]
        np.testing.assert_array_equal(halfway.colors, shown())
        assert (halfway.labels == Label.EMPTY).all()
        assert not halfway.depth.any()

    def test_motion_is_not_known_where_both_instants_contradict_each_other(self, tmp_path: Path) -> None:
        sign = wall()
        sign[20:40, 80:110] = 250
        store = thrown(tmp_path, 3, changes={0: wall(), 1: sign, 2: wall()})
        build_between(store)
        labels = store.underway("cam0", 0, 2)[1].labels
        assert (labels[22:38, 82:108] == Label.CONFLICT).float().mean() > 0.5
        assert (labels[45:, :70] == Label.EMPTY).all()

    def test_of_what_goes_too_far_for_flow_and_regions_nothing_is_known(self, tmp_path: Path) -> None:
        """A thing with another face at each instant: nothing of it is found back, and its way is not the wall's."""
        rng, images = np.random.default_rng(2), {}
        for frame, left in enumerate((20, 90, 30)):
            images[frame] = wall()
            images[frame][20:50, left : left + 25] = rng.integers(0, 255, (30, 25, 3))
        store = thrown(tmp_path, 3, changes=images)
        build_between(store)
        halfway = store.underway("cam0", 0, 2)[1]
        assert (halfway.labels[20:50, 20:115] == Label.CONFLICT).all()
        assert not halfway.depth[20:50, 20:115].any()
        assert (halfway.labels[:, 130:] == Label.EMPTY).all()

    def test_of_light_that_changes_everywhere_nothing_is_known(self, tmp_path: Path) -> None:
        store = thrown(tmp_path, 3, changes={2: shown() + 60})
        build_between(store)
        assert (store.underway("cam0", 1, 2)[1].labels == Label.CONFLICT).all()
        assert (store.underway("cam0", 0, 2)[1].labels != Label.CONFLICT).float().mean() > 0.9

    def test_it_is_made_once_and_anew_where_it_is_damaged_or_a_prior_changed(self, tmp_path: Path) -> None:
        store = thrown(tmp_path, 3)
        assert build_between(store) == 2
        assert build_between(store) == 0
        path = store.between[2].location("cam0", 1)
        path.write_bytes(path.read_bytes()[:-1] + b"x")
        assert build_between(store) == 2
        prior = store.prior("cam0", 2)
        maps = FusedPrior(*(map_.numpy() for map_ in (prior.depth, prior.labels, prior.sigma, prior.colors)))
        store.write("cam0", 2, maps, store.record("cam0", 2) | {"key": "another"})
        assert build_between(store) == 2

    @pytest.mark.parametrize("count", [1, 2, 4])
    def test_too_few_instants_or_those_of_an_unfinished_build_have_none_between(self, tmp_path, count: int) -> None:
        store = thrown(tmp_path, count)
        if count == 4:
            store.entries.location("cam0", 2).with_suffix(".json").unlink()
        assert build_between(store) == 0
        assert store.underway("cam0", 0, 2) is None

    def test_an_export_has_it_under_its_own_names(self, flown: PriorStore) -> None:
        renamed = RenamedStore(flown, {"a": "cam0"}, {10: 1, 11: 2})
        following, halfway = renamed.coded_underway("a", 10, 2)
        assert following == 11
        assert torch.equal(halfway.decoded().colors, flown.underway("cam0", 1, 2)[1].colors)
        assert renamed.coded_underway("a", 11, 2) is None  # frame 3 was not exported

    def test_the_contact_sheet_shows_it_below_the_priors(self, flown: PriorStore, tmp_path: Path) -> None:
        cameras = dict.fromkeys(flown.cameras, camera_at(size=(WIDTH, HEIGHT)))
        still = Recording("thrown", cameras, flown.frames, 1.0, Source())
        recording = showing(still, {"image": lambda camera, frame: shown(ball(*way(frame)))})
        stores = thrown(tmp_path, 5, 2), flown
        alone, both = (
            cv2.imread(str(contact_sheet(store, recording, tmp_path / "sheet.png", [0], width=64))) for store in stores
        )
        np.testing.assert_array_equal(both[: len(alone)], alone)
        contact_sheet(flown, recording, tmp_path / "flat.png", [0], width=1)  # rows of less than one pixel
        assert len(both) == len(alone) + 2 * (18 + 64 * HEIGHT // WIDTH)
