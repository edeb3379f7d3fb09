"""The 45 stiff and extreme cases that broke other codebases (reference/priors.md, section 7): each has its test here.

The table says which tests show which case. It cannot go stale unseen: every test that it names must exist, and every
test that bears a case's number must be about a case of the table.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent
RASTERIZER, SLICE, DEPTH = "test_rasterizer_stability.py", "test_slice_stability.py", "test_depth_cases.py"
ALIGN, STEREO = "test_align_stability.py", "test_stereo_stability.py"
BACKBONE, PRIORS = "test_backbone_cases.py", "test_priors_cases.py"

CASES: dict[int, tuple[str, str]] = {
    1: ("zero quaternion", f"{SLICE}::test_a_zero_quaternion_is_the_identity_and_receives_no_gradient"),
    2: ("quaternion norm 1e-20, 1e20", f"{SLICE}::test_the_norm_of_a_quaternion_changes_nothing_but_its_gradient"),
    3: ("quaternion not normalised", f"{SLICE}::test_gradients_include_the_normalisation_of_quaternions"),
    4: ("log-scale 100", f"{RASTERIZER}::test_case_4_"),
    5: ("scale 1e-12", f"{RASTERIZER}::test_case_5_"),
    6: ("anisotropy 1e-6 to 1e3", f"{RASTERIZER}::test_case_6_"),
    7: ("near plane", f"{RASTERIZER}::test_case_7_"),
    8: ("centre at the camera centre", f"{RASTERIZER}::test_case_7_and_8_"),
    9: ("outside the field-of-view clamp", f"{RASTERIZER}::test_case_9_"),
    10: ("Gaussian over all tiles", f"{RASTERIZER}::test_case_10_"),
    11: ("far and near together", f"{RASTERIZER}::test_case_11_"),
    12: ("world offset 1e6", f"{RASTERIZER}::test_case_12_"),
    13: ("NaN in one attribute", f"{RASTERIZER}::test_case_13_"),
    14: ("opacity logit ±50", f"{RASTERIZER}::test_case_14_"),
    15: ("200 opaque layers", f"{RASTERIZER}::test_case_15_"),
    16: ("alpha at 1/255", f"{RASTERIZER}::test_case_16_"),
    17: ("background and alpha gradients", f"{RASTERIZER}::test_case_17_"),
    18: ("no Gaussians", f"{DEPTH}::test_case_18_"),
    19: ("one, two, three Gaussians, duplicates", f"{DEPTH}::test_case_19_"),
    20: ("A(p) = 0", f"{DEPTH}::test_case_20_"),
    21: ("A = tau_v ± one ulp", f"{DEPTH}::test_case_21_"),
    22: ("A from 1e-8 to 1e-4", f"{DEPTH}::test_case_22_"),
    23: ("accumulated or normalised depth", f"{DEPTH}::test_case_23_"),
    24: ("D* of 1e-3 and 1e6", f"{DEPTH}::test_case_24_"),
    25: ("D* empty", f"{BACKBONE}::test_case_25_"),
    26: ("Charbonnier at 0, 1e-30, 1e20", f"{BACKBONE}::test_case_26_"),
    27: ("NaN in the prior", f"{BACKBONE}::test_case_27_"),
    28: ("temporal variance to 0", f"{SLICE}::test_a_vanishing_temporal_variance_at_its_own_instant_is_fully_there"),
    29: ("temporal variance 1e-20 to 1e20", f"{SLICE}::test_the_marginal_depends_on_standard_deviations_alone"),
    30: ("Schur complement in float32", f"{SLICE}::test_the_factor_keeps_positive_what_the_schur_complement_loses"),
    31: ("huge velocity", f"{SLICE}::test_a_huge_velocity_carries_a_gaussian_out_of_sight"),
    32: ("time outside, NaN time", f"{SLICE}::test_a_time_that_is_not_a_number_is_refused"),
    33: ("visible at no training timestamp", f"{BACKBONE}::test_case_33_"),
    34: ("no verified pixel", f"{BACKBONE}::test_case_34_"),
    35: ("D* <= 0", f"{BACKBONE}::test_case_35_"),
    36: ("every pixel under-reconstructed", f"{BACKBONE}::test_case_36_"),
    37: ("identical depths", f"{RASTERIZER}::test_case_37_"),
    38: ("image sizes, SSIM window", f"{DEPTH}::test_case_38_"),
    39: ("fx != fy, principal point outside", f"{RASTERIZER}::test_case_39_"),
    40: ("gradcheck of every operation", f"{DEPTH}::test_case_40_"),
    41: ("1e5 extreme draws", f"{RASTERIZER}::test_case_41_"),
    42: ("import order, no GPU, SIGABRT", f"{PRIORS}::test_case_42_"),
    43: ("monocular maps gone wrong", f"{ALIGN}::test_each_case_is_certified_or_refused_for_the_right_reason"),
    44: ("stereo without a chance", f"{STEREO}::test_a_frame_without_texture_has_no_depth"),
    45: ("aligned depth crosses 0", f"{ALIGN}::test_an_aligned_map_that_crosses_zero_is_empty_there"),
}
"""Number -> what it is, and the file with the name (or the beginning of the names) of its tests."""


def names_in(file: str) -> list[str]:
    """Names of the test functions and methods of a file beside this one."""
    tree = ast.parse((HERE / file).read_text())
    return [node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]


def test_the_table_has_all_45_cases() -> None:
    assert list(CASES) == list(range(1, 46))


@pytest.mark.parametrize("number", CASES)
def test_each_case_has_its_test(number: int) -> None:
    file, _, beginning = CASES[number][1].partition("::")
    assert (HERE / file).is_file(), f"{file} should hold case {number}: {CASES[number][0]}"
    assert any(name.startswith(beginning) for name in names_in(file)), f"no test of {file} begins with {beginning}"


def test_no_test_bears_a_number_that_is_no_case() -> None:
    for path in HERE.glob("test_*.py"):
        for name in names_in(path.name):
            for number in re.findall(r"case_(\d+)_", name):
                assert int(number) in CASES, f"{path.name}::{name}"
