"""The 45 stiff and extreme cases that broke other codebases: each has its test here.

The table says which tests show which case. It cannot go stale unseen: every test that it names must be one that pytest
runs, and every test that bears a case's number must have in its text what that case is about.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import pytest

HERE = Path(__file__).parent
RASTERIZER, SLICE, DEPTH = "test_rasterizer_stability.py", "test_slice_stability.py", "test_depth_cases.py"
ALIGN, STEREO = "test_align_stability.py", "test_stereo_stability.py"
BACKBONE, PRIORS = "test_backbone_cases.py", "test_priors_cases.py"


class Case(NamedTuple):
    """One of the 45."""

    what: str
    tests: str
    """File, and the name or the beginning of the names of the tests that show it."""
    shows: str
    """What each test with this number in its name has in its text, as a regular expression."""


CASES: dict[int, Case] = {
    1: Case(
        "zero quaternion",
        f"{SLICE}::test_a_zero_quaternion_is_the_identity_and_receives_no_gradient",
        r"zero_quaternion",
    ),
    2: Case(
        "quaternion norm 1e-20, 1e20",
        f"{SLICE}::test_the_norm_of_a_quaternion_changes_nothing_but_its_gradient",
        r"norm",
    ),
    3: Case(
        "quaternion not normalised",
        f"{SLICE}::test_gradients_include_the_normalisation_of_quaternions",
        r"normalisation",
    ),
    4: Case("log-scale 100", f"{RASTERIZER}::test_case_4_", r"1e38|exploded_scales"),
    5: Case("scale 1e-12", f"{RASTERIZER}::test_case_5_", r"1e-24"),
    6: Case("anisotropy 1e-6 to 1e3", f"{RASTERIZER}::test_case_6_", r"1e-6, 1e-3, 1e3"),
    7: Case("near plane", f"{RASTERIZER}::test_case_7_", r"near_plane"),
    8: Case("centre at the camera centre", f"{RASTERIZER}::test_case_7_and_8_", r"at_the_camera"),
    9: Case("outside the field-of-view clamp", f"{RASTERIZER}::test_case_9_", r"field_of_view_clamp"),
    10: Case("Gaussian over all tiles", f"{RASTERIZER}::test_case_10_", r"whole_image"),
    11: Case("far and near together", f"{RASTERIZER}::test_case_11_", r"near_and_far"),
    12: Case("world offset 1e6", f"{RASTERIZER}::test_case_12_", r"1e6, -2e6"),
    13: Case("NaN in one attribute", f"{RASTERIZER}::test_case_13_", r"\bnan\b"),
    14: Case("opacity logit ±50", f"{RASTERIZER}::test_case_14_", r"logit|clamped_alpha"),
    15: Case("200 opaque layers", f"{RASTERIZER}::test_case_15_", r"range\(200\)"),
    16: Case("alpha at 1/255", f"{RASTERIZER}::test_case_16_", r"/ 255|opacity=0.01"),
    17: Case("background and alpha gradients", f"{RASTERIZER}::test_case_17_", r"white"),
    18: Case("no Gaussians", f"{DEPTH}::test_case_18_", r"none at all|all_pruned"),
    19: Case("one, two, three Gaussians, duplicates", f"{DEPTH}::test_case_19_", r"1, 2, 3"),
    20: Case("A(p) = 0", f"{DEPTH}::test_case_20_", r"alpha == 0|alpha > 0|1e-30"),
    21: Case("A = tau_v ± one ulp", f"{DEPTH}::test_case_21_", r"nextafter"),
    22: Case("A from 1e-8 to 1e-4", f"{DEPTH}::test_case_22_", r"1e-8, 1e-6"),
    23: Case("accumulated or normalised depth", f"{DEPTH}::test_case_23_", r"normalised"),
    24: Case("D* of 1e-3 and 1e6", f"{DEPTH}::test_case_24_", r"1e6|unit"),
    25: Case("D* empty", f"{BACKBONE}::test_case_25_", r"unlabelled"),
    26: Case("Charbonnier at 0, 1e-30, 1e20", f"{BACKBONE}::test_case_26_", r"1e-30, 1e-8, 1.0, 1e20"),
    27: Case("NaN in the prior", f"{BACKBONE}::test_case_27_", r"\bnan\b"),
    28: Case(
        "temporal variance to 0",
        f"{SLICE}::test_a_vanishing_temporal_variance_at_its_own_instant_is_fully_there",
        r"1e-20|vanishing",
    ),
    29: Case(
        "temporal variance 1e-20 to 1e20", f"{SLICE}::test_the_marginal_depends_on_standard_deviations_alone", r"1e-20"
    ),
    30: Case(
        "Schur complement in float32",
        f"{SLICE}::test_the_factor_keeps_positive_what_the_schur_complement_loses",
        r"schur|100.0",
    ),
    31: Case("huge velocity", f"{SLICE}::test_a_huge_velocity_carries_a_gaussian_out_of_sight", r"huge_velocity"),
    32: Case("time outside, NaN time", f"{SLICE}::test_a_time_that_is_not_a_number_is_refused", r"inf|nan"),
    33: Case("visible at no training timestamp", f"{BACKBONE}::test_case_33_", r"no_view_sees"),
    34: Case("no verified pixel", f"{BACKBONE}::test_case_34_", r"unlabelled"),
    35: Case("D* <= 0", f"{BACKBONE}::test_case_35_", r"0.0, -1.0"),
    36: Case("every pixel under-reconstructed", f"{BACKBONE}::test_case_36_", r"empty_scene"),
    37: Case("identical depths", f"{RASTERIZER}::test_case_37_", r"ties"),
    38: Case("image sizes, SSIM window", f"{DEPTH}::test_case_38_", r"size"),
    39: Case("fx != fy, principal point outside", f"{RASTERIZER}::test_case_39_", r"\bK\b"),
    40: Case("gradcheck of every operation", f"{DEPTH}::test_case_40_", r"OPERATIONS"),
    41: Case("1e5 extreme draws", f"{RASTERIZER}::test_case_41_", r"extreme_scene|extremes|random_scene\(11|given"),
    42: Case("import order, no GPU, SIGABRT", f"{PRIORS}::test_case_42_", r"import|gpu|SIGABRT"),
    43: Case(
        "monocular maps gone wrong",
        f"{ALIGN}::test_each_case_is_certified_or_refused_for_the_right_reason",
        r"certified|refused",
    ),
    44: Case(
        "stereo without a chance", f"{STEREO}::test_a_frame_without_texture_has_no_depth", r"without_texture|one_place"
    ),
    45: Case(
        "aligned depth crosses 0", f"{ALIGN}::test_an_aligned_map_that_crosses_zero_is_empty_there", r"crosses_zero"
    ),
}
"""By number."""


class Collected(NamedTuple):
    """A test as pytest collects it, with the text that it consists of."""

    file: str
    name: str
    source: str


def numbers_in(name: str) -> list[int]:
    """The cases that a test's name bears: 7 and 8 for `test_case_7_and_8_at_the_near_plane`."""
    found = re.search(r"_case_((?:\d+_and_)*\d+)_", name)
    return [int(number) for number in found[1].split("_and_")] if found else []


def source_of(file: Path) -> dict[str, str]:
    """The text of each test of a file by name, decorators included."""
    text = file.read_text()
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    lines = text.splitlines()
    first = {node: min([node.lineno, *(part.lineno for part in node.decorator_list)]) for node in functions}
    return {node.name: "\n".join(lines[first[node] - 1 : node.end_lineno]) for node in functions}


def faults(cases: Mapping[int, Case], tests: Iterable[Collected]) -> list[str]:
    """What is wrong with the table: a case without a test, a number that is none, a test of another case's matter."""
    known = list(tests)
    found = [
        f"case {number} ({case.what}) has no test {case.tests}"
        for number, case in cases.items()
        if not any(f"{test.file}::{test.name}".startswith(case.tests) for test in known)
    ]
    for test in known:
        for number in numbers_in(test.name):
            if number not in cases:
                found.append(f"{test.name} bears the number of no case")
            elif not re.search(cases[number].shows, test.source):
                found.append(f"{test.name} is not about case {number} ({cases[number].what})")
    return found


@pytest.fixture(scope="module")
def collected() -> list[Collected]:
    """The tests of this folder that a plain run of pytest would run."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", str(HERE)]
    listing = subprocess.run(command, capture_output=True, text=True, cwd=HERE.parents[1])
    assert listing.returncode == 0, listing.stdout + listing.stderr
    names = dict.fromkeys(re.findall(r"(\w+\.py)(?:::\w+)*?::(\w+)(?:\[.*\])?$", listing.stdout, re.MULTILINE))
    sources = {file: source_of(HERE / file) for file, _ in names}
    return [Collected(file, name, sources[file][name]) for file, name in names]


def test_the_table_has_all_45_cases() -> None:
    assert list(CASES) == list(range(1, 46))


def test_each_case_has_a_test_that_runs_and_each_number_is_that_of_its_case(collected: list[Collected]) -> None:
    assert faults(CASES, collected) == []


def test_a_table_that_is_wrong_is_found_out(collected: list[Collected]) -> None:
    renamed = CASES[12]._replace(tests=f"{RASTERIZER}::test_case_12_which_nobody_wrote")
    assert faults({**CASES, 12: renamed}, collected) == [f"case 12 (world offset 1e6) has no test {renamed.tests}"]
    exchanged = {**CASES, 5: CASES[5]._replace(shows=CASES[15].shows), 15: CASES[15]._replace(shows=CASES[5].shows)}
    assert sum("is not about case" in fault for fault in faults(exchanged, collected)) == 2
    skipped = [test for test in collected if 17 not in numbers_in(test.name)]
    assert faults(CASES, skipped) == [f"case 17 ({CASES[17].what}) has no test {CASES[17].tests}"]
    stray = Collected(RASTERIZER, "test_case_46_and_more", "")
    assert faults(CASES, [*collected, stray]) == ["test_case_46_and_more bears the number of no case"]


def test_a_name_may_bear_several_numbers() -> None:
    assert numbers_in("test_case_7_and_8_at_the_near_plane") == [7, 8]
    assert numbers_in("test_case_18_nothing_to_draw") == [18]
    assert numbers_in("test_each_case_is_certified") == []
