"""Reports and pictures of a calibration of an arm, its linkages and the calibrator itself."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

import hydrotele
from hydrotele.calibrate.arm import ArmFit, stage_residuals
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.bad_data import Region
from hydrotele.calibrate.design import ARMS, FOREARMS, Design, Survey
from hydrotele.calibrate.linkage import NAMES, LinkageFit, values_of
from hydrotele.calibrate.loop import unit_of
from hydrotele.show.report_html import Section, drawing, png, write_sections

_MOST_TIP = 0.06  # m: the colour scale of the designs ends there


def write_arm_report(
    fit: ArmFit, stages: Sequence[Poses], regions: Sequence[Region], path: Path
) -> None:
    """Write the report of an arm.

    Args:
        fit: of the arm.
        stages: the fitted poses.
        regions: corrupted readings that were found.
        path: HTML file to write.
    """
    rows = []
    for name, value, deviation in zip(fit.names, fit.values, fit.deviations, strict=True):
        scale = np.degrees(1.0) if unit_of(name) == "rad" else 1e3
        unit = "deg" if unit_of(name) == "rad" else "mm"
        rows.append((name, f"{scale * fit.start[name]:.2f} {unit}", f"{scale * value:.2f} {unit}",
                     f"{1.96 * scale * deviation:.2f} {unit}"))  # fmt: skip
    kept = [(s.link, name, why) for s in fit.stages for name, why in s.fixed.items()]
    sections = [
        Section("Parameters", head=("parameter", "nominal", "identified", "+-"), rows=rows),
        Section("Kept parameters", "What the poses do not tell keeps its value.",
                ("moving link", "parameter", "why"), kept),
    ]  # fmt: skip
    if regions:
        found = [(r.link, f"{r.first} to {r.last}", r.joint or "the arm's own sensor",
                  f"{np.degrees(r.size):.2f} deg") for r in regions]  # fmt: skip
        sections.append(Section(
            "Corrupted readings", "Left out where the calibrator is to blame.",
            ("moving link", "poses", "joint", "RMS error"), found,
        ))  # fmt: skip
    sections.append(Section("Residuals", "In units of the sensors' errors.",
                            picture=draw_residuals(fit, stages)))  # fmt: skip
    write_sections(
        path, f"hydrotele {hydrotele.__version__} - calibrate arm",
        f"{fit.nominal.machine}: {len(fit.names)} parameters, {fit.method}",
        "Angle-free closed-chain identification with an external calibrator (Khoshzaban 1992,"
        " chapter 3); intervals cover 95 %.", sections,
    )  # fmt: skip


def draw_residuals(fit: ArmFit, stages: Sequence[Poses]) -> bytes:
    """Residuals of both equations over the poses, a PNG; a row per moving link."""
    with drawing(0.4 + 1.5 * len(stages)) as figure:
        places = figure.subplots(len(stages), 1, squeeze=False)[:, 0]
        for place, poses in zip(places, stages, strict=True):
            rows = stage_residuals(fit.nominal, poses, fit.numbers)
            place.plot(rows[:, 0], ".", ms=3, color="#1769aa", label="distance")
            place.plot(rows[:, 1], ".", ms=3, color="#e07b00", label="height")
            place.set_title(f"{poses.link} moves")
            place.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        places[-1].set_xlabel("pose")
        return png(figure)


def write_linkage_report(fits: Sequence[LinkageFit], path: Path) -> None:
    """Write the report of cylinder linkages.

    Args:
        fits: one per axis.
        path: HTML file to write.
    """
    sections = []
    for found in fits:
        deviations = dict(zip(found.fit.names, found.fit.deviations, strict=True))
        rows = []
        for name, nominal, value in zip(NAMES, found.nominal, values_of(found), strict=True):
            scale, unit = (np.degrees(1.0), "deg") if name == "theta_off" else (1e3, "mm")
            wide = f"{1.96 * scale * deviations[name]:.2f} {unit}" if name in deviations else "held"
            rows.append(
                (name, f"{scale * nominal:.2f} {unit}", f"{scale * value:.2f} {unit}", wide)
            )
        said = (f"RMS {1e3 * found.rms:.2f} mm, VAF {found.vaf:.3f} % on samples that were not"
                f" fitted; {found.angles} angles.")  # fmt: skip
        sections.append(Section(found.axis, said, ("parameter", "nominal", "identified", "+-"),
                                rows, picture=draw_linkage(found)))  # fmt: skip
    write_sections(
        path, f"hydrotele {hydrotele.__version__} - calibrate linkage", "Cylinder linkages",
        "The triangle of pins under each cylinder (Khoshzaban 1992, Eq. 3.26), judged on samples"
        " that were not fitted.", sections,
    )  # fmt: skip


def draw_linkage(found: LinkageFit) -> bytes:
    """Error of the displacement over the joint's angle, a PNG."""
    with drawing(2.4) as figure:
        place = figure.subplots()
        place.plot(np.degrees(found.angle), 1e3 * found.residual, ".", ms=2, color="#1769aa")
        place.set_title(f"{found.axis}: error of the piston displacement [mm]")
        place.set_xlabel("joint angle [deg]")
        return png(figure)


def draw_designs(survey: Survey, best: Design) -> bytes:
    """Error of the arm's tip, information and reach over the lengths of both arms, a PNG."""
    shape = len(FOREARMS), len(ARMS)
    tip = np.array([d.tip_error for d in survey.designs]).reshape(shape)
    told = np.array([d.information for d in survey.designs]).reshape(shape)
    reached = np.array([d.reached for d in survey.designs]).reshape(shape)
    told = np.where(np.isfinite(told), told, np.nan) / np.log(10.0)
    panels = (
        ("tip of the calibrated arm,\nstandard deviation [mm]", 1e3 * np.minimum(tip, _MOST_TIP),
         "viridis_r", "%.0f"),
        ("information about the arm,\nlog10 of the determinant", told, "viridis", "%.0f"),
        ("poses that the calibrator\nreaches [%]", 100.0 * reached, "viridis", "%.0f"),
    )  # fmt: skip
    with drawing(4.0) as figure:
        for place, (title, values, colours, form) in zip(
            figure.subplots(1, 3, sharey=True), panels, strict=True
        ):
            shown = place.contourf(ARMS, FOREARMS, values, 12, cmap=colours)
            figure.colorbar(shown, ax=place, format=form, shrink=0.7)
            for one, mark, label in ((survey.present, "o", "Khoshzaban 1992"), (best, "*", "best")):
                place.plot(one.arm, one.forearm, mark, ms=10, mfc="white", mec="black", label=label)
            place.set_title(title, fontsize=8.5)
            place.set_xlabel("arm [m]")
            place.grid(visible=False)
            place.set_aspect("equal")
        figure.axes[0].set_ylabel("forearm [m]")
        figure.axes[0].legend(loc="lower left", fontsize=8)
        return png(figure)
