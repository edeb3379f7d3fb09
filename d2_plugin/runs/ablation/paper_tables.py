"""The paper's published figures, so that they can stand beside ours: as hollow marks, labelled as the paper's.

They were measured by its authors on their machine with camera splits that are not public (supplement), so they are no
target of ours and are compared with nothing here. SSIM_2 below SSIM_1 in several rows of the main comparison shows that
these two columns cannot both come from one window (see `d2_plugin.runs.metrics`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from d2_plugin.errors import unknown_name
from d2_plugin.runs.markup import Table, escaped, latex, markdown

SOURCE = "D²-4DGS paper, as published, not measured here"
MARK = "○"
"""What a published figure carries in a table or a plot, where ours are filled."""

DATASETS = ("N3DV", "Technicolor", "ENeRF-Outdoor")
TABLES = {
    "main": "tab:main_results: means over the scenes of three data sets with 2, 3 and 4 views",
    "ablation": "tab:ablation: sear_steak of N3DV, 4 views",
    "pruning": "tab:pruning_criteria: actor5_6 of ENeRF-Outdoor, 4 views",
}
"""The paper's label and what each table is about."""


@dataclass(frozen=True)
class PaperRow:
    """One row of one of the paper's tables for one data set and number of views."""

    table: str
    method: str
    """As the paper writes it."""
    preset: str | None
    """Name of the row in `d2_plugin.runs.ablation.presets`; None for other methods."""
    dataset: str
    scene: str | None
    """None for a mean over the scenes of a data set."""
    views: int
    psnr: float
    ssim1: float
    ssim2: float
    lpips: float

    @property
    def label(self) -> str:
        """What to write at its mark."""
        return f"{self.method} (paper)"

    @property
    def scores(self) -> dict[str, float]:
        """By the names of `metrics.json`."""
        return {"psnr": self.psnr, "ssim1": self.ssim1, "ssim2": self.ssim2, "lpips": self.lpips}

    @property
    def error(self) -> float:
        """Root mean square error of held-out colour in 0..1 that the PSNR stands for, as rows of runs.jsonl have it."""
        return 10 ** (-self.psnr / 20)


def paper_rows(
    table: str | None = None,
    *,
    dataset: str | None = None,
    views: int | None = None,
    presets: Iterable[str] | None = None,
) -> list[PaperRow]:
    """Rows in the paper's order, of one `table`, `dataset`, number of `views` or of `presets` where given.

    Raises:
        D2Error: an unknown table or data set.
    """
    if table is not None and table not in TABLES:
        raise unknown_name("table of the paper", table, TABLES)
    if dataset is not None and dataset not in DATASETS:
        raise unknown_name("data set of the paper", dataset, DATASETS)
    wanted = None if presets is None else set(presets)
    return [
        row
        for row in ROWS
        if table in (None, row.table)
        and dataset in (None, row.dataset)
        and views in (None, row.views)
        and (wanted is None or row.preset in wanted)
    ]


def paper_table(rows: Sequence[PaperRow], as_latex: bool = False) -> str:
    """Markdown or LaTeX of published rows, each labelled as the paper's; four digits as there."""
    header = ("method", "data set", "views", "PSNR", "SSIM1", "SSIM2", "LPIPS")
    cells = [
        (
            f"{MARK} {row.label}",
            row.dataset + (f", {row.scene}" if row.scene else ""),
            str(row.views),
            *(f"{score:.4f}" for score in row.scores.values()),
        )
        for row in rows
    ]
    if as_latex:
        return latex(Table(header, tuple(tuple(map(escaped, line)) for line in cells)), columns="llccccc")
    return f"{markdown(Table(header, tuple(cells)))}\n\n{MARK} {SOURCE}."


_MAIN = """
2 4DGS     19.3465 0.7251 0.7249 0.2295   13.8565 0.4919 0.4588 0.4447   16.1750 0.3120 0.3348 0.4528
2 Ex4DGS   17.2522 0.6622 0.7440 0.2932   14.0678 0.4191 0.5479 0.4662   13.9378 0.2496 0.4133 0.5156
2 CEM-4DGS 17.8677 0.6896 0.7657 0.2717   14.3640 0.4267 0.5546 0.4595   13.7995 0.2575 0.4264 0.5086
2 STGS     18.5025 0.7029 0.6825 0.2577   20.7975 0.7613 0.7508 0.2050   15.9265 0.3515 0.3295 0.3555
2 Swift4D  15.5046 0.6549 0.6360 0.3478   14.1178 0.4068 0.3293 0.4999   15.8813 0.3043 0.3883 0.4060
2 4C4D     19.2770 0.7047 0.7936 0.2171   14.4915 0.4149 0.5857 0.5295   16.2983 0.3023 0.5306 0.4299
2 D²-4DGS  21.4668 0.8011 0.8189 0.1968   21.8570 0.7933 0.7853 0.1818   17.5073 0.4059 0.4965 0.3800
3 4DGS     21.6551 0.7988 0.8305 0.1604   17.7284 0.5907 0.5838 0.3720   19.5915 0.3658 0.4899 0.3432
3 Ex4DGS   19.8208 0.7603 0.8211 0.1797   24.0245 0.8002 0.8730 0.1550   16.5998 0.3049 0.4788 0.4324
3 CEM-4DGS 21.6185 0.7951 0.8500 0.1486   24.2131 0.8046 0.8759 0.1472   16.4353 0.3052 0.4841 0.4177
3 STGS     21.8865 0.7852 0.7728 0.1691   26.0144 0.8441 0.8374 0.1277   18.9614 0.3989 0.3806 0.2789
3 Swift4D  21.3068 0.7996 0.8276 0.1692   14.9963 0.4529 0.4090 0.4546   19.3271 0.3880 0.5768 0.2582
3 4C4D     21.4542 0.7642 0.8420 0.1640   16.9738 0.5177 0.6764 0.4563   18.9710 0.3678 0.5862 0.3413
3 D²-4DGS  22.7561 0.8349 0.8589 0.1467   27.3255 0.8684 0.8639 0.1098   20.7804 0.4244 0.6125 0.2696
4 4DGS     23.3693 0.8411 0.8705 0.1253   19.3320 0.6070 0.5952 0.3648   20.7969 0.4116 0.5980 0.3143
4 Ex4DGS   22.0370 0.8185 0.8690 0.1345   25.5925 0.8103 0.8826 0.1479   17.7221 0.3248 0.5039 0.3997
4 CEM-4DGS 22.5162 0.8303 0.8782 0.1216   25.5847 0.8142 0.8849 0.1395   18.1062 0.3287 0.5104 0.3789
4 STGS     22.8793 0.8249 0.8187 0.1320   27.7342 0.8514 0.8448 0.1197   20.2357 0.4169 0.3958 0.2604
4 Swift4D  22.3474 0.8354 0.8695 0.1254   16.1208 0.5035 0.4741 0.4109   20.7893 0.4027 0.6028 0.2429
4 4C4D     23.0567 0.8198 0.8840 0.1280   18.5855 0.5519 0.7075 0.4450   20.5427 0.3927 0.6091 0.3117
4 D²-4DGS  24.9534 0.8636 0.9000 0.1211   29.1182 0.8763 0.8720 0.1061   22.0253 0.5205 0.6500 0.2557
"""
"""Views, method, then PSNR, SSIM_1, SSIM_2 and LPIPS on each data set."""

_ABLATION = (
    ("Backbone", "backbone", (25.3987, 0.8784, 0.9067, 0.1136)),
    ("Mono only", "mono_only", (25.9236, 0.8840, 0.9145, 0.1098)),
    ("MVS only", "mvs_only", (25.6174, 0.8815, 0.9106, 0.1115)),
    ("Dual w/o align.", "dual_unaligned", (25.8469, 0.8832, 0.9130, 0.1107)),
    ("Dual w/o verify.", "dual_unverified", (26.1183, 0.8875, 0.9188, 0.1088)),
    ("w/o Densification", "no_densification", (26.0384, 0.8849, 0.9161, 0.1096)),
    ("w/o Pruning", "no_pruning", (26.5217, 0.8915, 0.9231, 0.1059)),
    ("w/o RGB-D", "no_rgbd", (26.4472, 0.8910, 0.9225, 0.1068)),
    ("D²-4DGS", "full", (27.2302, 0.9023, 0.9337, 0.0924)),
)

_PRUNING = (
    ("No pruning", "no_pruning", (21.1874, 0.4618, 0.5662, 0.2549)),
    ("Opacity only", "opacity_only", (21.5663, 0.4789, 0.6107, 0.2534)),
    ("Depth only", "depth_only", (21.9076, 0.5015, 0.6428, 0.2514)),
    ("Joint (Ours)", "full", (22.2082, 0.5183, 0.6693, 0.2496)),
)


def _main_rows() -> Iterable[PaperRow]:
    for line in _MAIN.strip().splitlines():
        views, method, *numbers = line.split()
        preset = "full" if method == "D²-4DGS" else None
        for place, dataset in enumerate(DATASETS):
            scores = [float(number) for number in numbers[4 * place : 4 * place + 4]]
            yield PaperRow("main", method, preset, dataset, None, int(views), *scores)


ROWS: tuple[PaperRow, ...] = (
    *_main_rows(),
    *(PaperRow("ablation", method, preset, "N3DV", "sear_steak", 4, *s) for method, preset, s in _ABLATION),
    *(PaperRow("pruning", method, preset, "ENeRF-Outdoor", "actor5_6", 4, *s) for method, preset, s in _PRUNING),
)
"""All published rows."""
