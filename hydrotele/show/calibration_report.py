"""Write reports and figures of calibrations of arms, linkages, calibrators and serial robots."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import hydrotele
from hydrotele.calibrate.arm_identification import ArmFit, stage_residuals
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.bad_data import CorruptedRegion
from hydrotele.calibrate.calibration_loop import unit_of
from hydrotele.calibrate.calibrator_design import ARM_LENGTHS, FOREARM_LENGTHS, Design, DesignSurvey
from hydrotele.calibrate.linkage_identification import PARAMETER_NAMES, LinkageFit, linkage_parameters
from hydrotele.calibrate.socket_calibration import HeldOutPrediction, SocketCalibration
from hydrotele.show.report_html import Section, figure_to_png, open_report_figure, write_sections

_MAX_TIP_ERROR = 0.06  # m, upper limit of the colour scale of the designs


def write_arm_report(fit: ArmFit, stages: Sequence[Poses], regions: Sequence[CorruptedRegion], path: Path) -> None:
    """Write the HTML report of an arm calibration: parameters, corrupted samples and residuals.

    Args:
        fit: fitted parameters of the arm.
        stages: fitted poses, one item per log.
        regions: detected corrupted samples.
        path: HTML file to write.
    """
    rows = []
    for name, value, deviation in zip(fit.names, fit.values, fit.standard_deviations, strict=True):
        scale = np.degrees(1.0) if unit_of(name) == "rad" else 1e3
        unit = "deg" if unit_of(name) == "rad" else "mm"
        rows.append((name, f"{scale * fit.start_parameters[name]:.2f} {unit}", f"{scale * value:.2f} {unit}",
                     f"{1.96 * scale * deviation:.2f} {unit}"))  # fmt: skip
    kept = [(s.link, name, why) for s in fit.stages for name, why in s.hold_reasons.items()]
    sections = [
        Section("Parameters", head=("parameter", "nominal", "identified", "95 % +-"), rows=rows),
        Section("Fixed parameters", "Parameters that are not identifiable from the poses keep"
                " their nominal values.", ("moving link", "parameter", "reason"), kept),
    ]  # fmt: skip
    if regions:
        found = [(r.link, f"{r.first} to {r.last}", r.joint or "the arm's own sensor",
                  f"{np.degrees(r.size):.2f} deg") for r in regions]  # fmt: skip
        sections.append(Section(
            "Corrupted samples", "Poses with errors of an angle sensor. They were excluded if the"
            " sensor belongs to the calibrator.", ("moving link", "poses", "joint", "RMS error"),
            found,
        ))  # fmt: skip
    sections.append(Section("Residuals", "Residuals of the distance and height equations of each"
                            " pose, divided by the standard deviation due to sensor noise.",
                            picture=draw_residuals(fit, stages)))  # fmt: skip
    write_sections(
        path, f"hydrotele {hydrotele.__version__} - calibrate arm",
        f"{fit.nominal.machine}: {len(fit.names)} parameters, {fit.method}",
        "Angle-free closed-chain identification with an external calibrator (Khoshzaban 1992,"
        " chapter 3). The columns +- are half widths of 95 % intervals.", sections,
    )  # fmt: skip


def draw_residuals(fit: ArmFit, stages: Sequence[Poses]) -> bytes:
    """Draw the residuals of an arm calibration over the poses as PNG, one panel per moving link.

    Each pose has two loop-closure equations, for distance and height; their residuals are divided by
    the standard deviation due to sensor noise.
    """
    with open_report_figure(0.4 + 1.5 * len(stages)) as figure:
        places = figure.subplots(len(stages), 1, squeeze=False)[:, 0]
        for place, poses in zip(places, stages, strict=True):
            rows = stage_residuals(fit.nominal, poses, fit.parameters)
            place.plot(rows[:, 0], ".", ms=3, color="#1769aa", label="distance")
            place.plot(rows[:, 1], ".", ms=3, color="#e07b00", label="height")
            place.set_title(f"residual / sensor noise [1], moving link {poses.link}")
            place.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        places[-1].set_xlabel("pose")
        return figure_to_png(figure)


def write_linkage_report(fits: Sequence[LinkageFit], path: Path) -> None:
    """Write the HTML report of calibrated cylinder linkages: pin geometry and held-out errors per axis.

    Args:
        fits: fitted linkages, one per axis.
        path: HTML file to write.
    """
    sections = []
    for found in fits:
        deviations = dict(zip(found.fit.names, found.fit.standard_deviations, strict=True))
        rows = []
        for name, nominal, value in zip(PARAMETER_NAMES, found.nominal, linkage_parameters(found), strict=True):
            scale, unit = (np.degrees(1.0), "deg") if name == "theta_off" else (1e3, "mm")
            wide = f"{1.96 * scale * deviations[name]:.2f} {unit}" if name in deviations else "held"
            rows.append((name, f"{scale * nominal:.2f} {unit}", f"{scale * value:.2f} {unit}", wide))
        said = (f"RMS displacement error {1e3 * found.rms:.2f} mm (lower is better) and variance"
                f" accounted for (VAF) {found.vaf:.3f} % (higher is better) on held-out samples;"
                f" {found.angle_source} joint angles.")  # fmt: skip
        sections.append(Section(found.axis, said, ("parameter", "nominal", "identified", "95 % +-"),
                                rows, picture=draw_linkage_errors(found)))  # fmt: skip
    write_sections(
        path, f"hydrotele {hydrotele.__version__} - calibrate linkage", "Cylinder linkages",
        "Calibration of the pin triangle of each cylinder (Khoshzaban 1992, Eq. 3.26), validated on"
        " samples that were not fitted.", sections,
    )  # fmt: skip


def draw_linkage_errors(fit: LinkageFit) -> bytes:
    """Draw the errors of the piston displacement [mm] of a fitted linkage over the joint angle as PNG.

    All samples are shown, fitted and held-out ones.
    """
    with open_report_figure(2.4) as figure:
        place = figure.subplots()
        place.plot(np.degrees(fit.angle), 1e3 * fit.residual, ".", ms=2, color="#1769aa")
        place.set_title(f"{fit.axis}: error of the piston displacement [mm]")
        place.set_xlabel("joint angle [deg]")
        return figure_to_png(figure)


def draw_designs(survey: DesignSurvey, best: Design) -> bytes:
    """Draw three maps of calibrator designs over the two link lengths, arm and forearm, as PNG.

    The maps show the tip error of the calibrated arm, the information on its parameters and the
    fraction of poses that the calibrator reaches. The present and the best design are marked.

    Args:
        survey: designs on the grid of link lengths, and the present design.
        best: best design.
    """
    shape = len(FOREARM_LENGTHS), len(ARM_LENGTHS)
    tip = np.array([d.tip_error for d in survey.designs]).reshape(shape)
    told = np.array([d.information for d in survey.designs]).reshape(shape)
    reached = np.array([d.reached for d in survey.designs]).reshape(shape)
    told = np.where(np.isfinite(told), told, np.nan) / np.log(10.0)
    panels = (
        ("tip error of the calibrated arm,\nstandard deviation [mm]",
         1e3 * np.minimum(tip, _MAX_TIP_ERROR), "viridis_r", "%.0f"),
        ("information on the parameters,\nlog10 of the determinant [1]", told, "viridis", "%.0f"),
        ("poses reached by the\ncalibrator [%]", 100.0 * reached, "viridis", "%.0f"),
    )  # fmt: skip
    with open_report_figure(4.0) as figure:
        for place, (title, values, colours, form) in zip(figure.subplots(1, 3, sharey=True), panels, strict=True):
            shown = place.contourf(ARM_LENGTHS, FOREARM_LENGTHS, values, 12, cmap=colours)
            figure.colorbar(shown, ax=place, format=form, shrink=0.7)
            for one, mark, label in ((survey.present, "o", "Khoshzaban 1992"), (best, "*", "best")):
                place.plot(one.arm, one.forearm, mark, ms=10, mfc="white", mec="black", label=label)
            place.set_title(title, fontsize=8.5)
            place.set_xlabel("arm [m]")
            place.grid(visible=False)
            place.set_aspect("equal")
        figure.axes[0].set_ylabel("forearm [m]")
        figure.axes[0].legend(loc="lower left", fontsize=8)
        return figure_to_png(figure)


_NOMINAL_COLOUR, _CALIBRATED_COLOUR, _MARK_COLOUR = "#b9bfc7", "#1769aa", "#e07b00"
_MAX_SCATTER_POINTS = 3000  # maximum number of points of a scatter plot
_CONTOUR_PROBABILITIES = (
    0.39,
    0.86,
)  # probability within 1 and 2 standard deviations of a 2D normal distribution


def draw_pose_errors(errors: Mapping[str, tuple[np.ndarray, np.ndarray]], description: str) -> bytes:
    """Draw the errors of each pose before and after calibration as bars on a logarithmic scale.

    Args:
        errors: {title with unit: (errors before (n,), errors after (n,))}, in the unit of the
            title.
        description: description of the poses, such as `held-out poses`.

    Returns:
        A PNG.
    """
    with open_report_figure(0.3 + 1.9 * len(errors)) as figure:
        axes = figure.subplots(len(errors), 1, squeeze=False)[:, 0]
        for place, (title, (before, after)) in zip(axes, errors.items(), strict=True):
            at = np.arange(1, len(before) + 1)
            place.bar(at - 0.2, before, 0.4, color=_NOMINAL_COLOUR, label="nominal")
            place.bar(at + 0.2, after, 0.4, color=_CALIBRATED_COLOUR, label="calibrated")
            place.set_yscale("log")
            place.set_title(f"{title}, {len(before)} {description}")
            place.margins(x=0.01)
            place.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        axes[-1].set_xlabel("pose")
        return figure_to_png(figure)


def draw_posterior(
    sample: np.ndarray, names: Sequence[str], mark: np.ndarray | None = None,
    mark_label: str = "", unit: str = "mm or mrad",
) -> bytes:  # fmt: skip
    """Draw marginal posteriors: histograms on the diagonal, pairs of parameters below it.

    Args:
        sample: (n, p) samples of the posterior [unit].
        names: names of the p parameters.
        mark: (p,) reference values to mark, such as the truth [unit], or None.
        mark_label: description of the reference values.
        unit: unit of all parameters.

    Returns:
        A PNG.
    """
    p = len(names)
    thin = sample[:: max(1, len(sample) // _MAX_SCATTER_POINTS)]
    with open_report_figure(1.5 * p) as figure:
        axes = figure.subplots(p, p, squeeze=False, sharex="col")
        for row in range(p):
            for column in range(p):
                place = axes[row, column]
                if column > row:
                    place.axis("off")
                    continue
                if row == column:
                    place.hist(sample[:, row], 40, density=True, color=_CALIBRATED_COLOUR, alpha=0.8)
                    place.set_yticks([])
                else:
                    place.plot(
                        thin[:, column],
                        thin[:, row],
                        ".",
                        ms=1.5,
                        alpha=0.3,
                        color=_CALIBRATED_COLOUR,
                    )
                    _draw_contours(place, sample[:, column], sample[:, row])
                    share = np.corrcoef(sample[:, column], sample[:, row])[0, 1]
                    place.text(0.04, 0.96, f"{share:+.2f}", transform=place.transAxes, va="top",
                               fontsize=7)  # fmt: skip
                if mark is not None:
                    place.axvline(mark[column], color=_MARK_COLOUR, lw=1.0)
                    if row != column:
                        place.axhline(mark[row], color=_MARK_COLOUR, lw=1.0)
                if row == p - 1:
                    place.set_xlabel(f"{names[column]}")
                if column == 0 and row > 0:
                    place.set_ylabel(f"{names[row]}")
                elif column > 0:
                    place.set_yticklabels([])
        label = f"{unit}; lines: {mark_label}" if mark is not None else unit
        figure.suptitle(f"Posterior [{label}]; numbers: correlation", fontsize=9)
        return figure_to_png(figure)


def _draw_contours(place, x: np.ndarray, y: np.ndarray) -> None:
    """Draw the two contours of the density of samples (x, y) that enclose 39 % and 86 % of them."""
    counts, xs, ys = np.histogram2d(x, y, 30)
    order = np.sort(counts.ravel())[::-1]
    share = np.cumsum(order) / order.sum()
    levels = sorted({float(order[np.searchsorted(share, level)]) for level in _CONTOUR_PROBABILITIES})
    middle = [0.5 * (edge[1:] + edge[:-1]) for edge in (xs, ys)]
    place.contour(*middle, counts.T, levels=levels, colors="#0d3f66", linewidths=0.8)


NOMINAL_POINTS_COLOUR, CALIBRATED_POINTS_COLOUR = "#e07b00", "#1769aa"


def draw_socket_errors(calibration: SocketCalibration, heldout_parts: Sequence[HeldOutPrediction]) -> bytes:
    """Draw errors of a robot calibration with ball and sockets, for the nominal and the calibrated robot.

    The upper plot shows the distance of the predicted ball from its mean position in the socket,
    for both robots. The lower plot shows the distances of neighbouring sockets by the calibrated
    robot.

    Args:
        calibration: result of the calibration.
        heldout_parts: predictions of held-out places; if empty, the fitted places are shown.

    Returns:
        A PNG.
    """
    before, after, apart = {}, {}, {}
    for one in heldout_parts:
        before |= one.nominal_errors.distances_by_socket
        after |= one.calibrated_errors.distances_by_socket
        apart |= one.calibrated_errors.socket_distances
    if not heldout_parts:
        before, after, apart = (
            calibration.nominal_errors.distances_by_socket,
            calibration.calibrated_errors.distances_by_socket,
            calibration.calibrated_errors.socket_distances,
        )
    names = list(after)
    with open_report_figure(6.4) as figure:
        upper, lower = figure.subplots(2, 1, height_ratios=(1.7, 1.0))
        place = 0
        for k, name in enumerate(names):
            x = place + np.arange(len(after[name]))
            for rows, colour, label in (
                (
                    before[name],
                    NOMINAL_POINTS_COLOUR,
                    "nominal robot, only the ball position fitted",
                ),
                (
                    after[name],
                    CALIBRATED_POINTS_COLOUR,
                    "calibrated on the other places" if heldout_parts else "calibrated",
                ),
            ):
                upper.plot(x, 1e3 * rows, ".", color=colour, ms=4, label="" if k else label)
                rms = 1e3 * float(np.sqrt(np.mean(rows**2)))
                upper.plot(x[[0, -1]], [rms, rms], color=colour, lw=1.6)
            if k % 2:
                upper.axvspan(place - 0.5, place + len(x) - 0.5, color="0.96", lw=0, zorder=0)
            place += len(x)
        middles = np.cumsum([0, *(len(after[n]) for n in names)])
        upper.set_xticks(0.5 * (middles[1:] + middles[:-1]))
        upper.set_xticklabels([n.replace("/", "\n").replace("hole_", "socket ") for n in names],
                              fontsize=7 if len(names) > 8 else 8.5)  # fmt: skip
        upper.tick_params(axis="x", length=0)
        upper.grid(axis="x", visible=False)
        upper.set_xlim(-0.5, place - 0.5)
        upper.set_yscale("log")
        upper.yaxis.set_major_formatter("{x:g}")
        upper.set_ylabel("distance from mean\nball position [mm]")
        upper.set_title(f"{calibration.nominal.name}: scatter of the predicted ball; lines: RMS")
        upper.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False,
                     fontsize=8.5, borderaxespad=0.1, markerscale=2.0)  # fmt: skip
        _draw_distances(lower, apart, calibration.options.distance)
        return figure_to_png(figure)


def _draw_distances(plot: Any, distances: dict[str, float], given_distance: float | None) -> None:
    if not distances:
        plot.set_axis_off()
        plot.text(0.0, 0.5, "no place has two sockets", transform=plot.transAxes)
        return
    values = 1e3 * np.array(list(distances.values()))
    x = np.arange(len(values))
    plot.plot(x, values, "o", color=CALIBRATED_POINTS_COLOUR, ms=6)
    if given_distance is not None:
        plot.axhspan(1e3 * given_distance - 0.1, 1e3 * given_distance + 0.1, color="0.5", alpha=0.15, lw=0)
        plot.axhline(1e3 * given_distance, color="0.4", lw=1.0)
        reach = 1.25 * max(0.2, float(np.abs(values - 1e3 * given_distance).max()))
        plot.set_ylim(1e3 * given_distance - reach, 1e3 * given_distance + reach)
    plot.set_xticks(x)
    plot.set_xticklabels(list(distances))
    plot.set_xlim(-0.6, len(values) - 0.4)
    plot.grid(axis="x", visible=False)
    plot.set_ylabel("socket distance [mm]")
    plot.set_title("Distance of the sockets; grey: given distance +- 0.1 mm")


def write_robot_report(path: Path, document: dict[str, Any], picture: bytes) -> None:
    """Write the report of a robot calibration as one self-contained HTML file.

    Args:
        path: HTML file to write.
        document: content of `calibration.json`.
        picture: PNG of `draw_socket_errors`.
    """
    judged, fitted = document["heldout"], document["fitted"]
    figures = [
        ("before", fitted["nominal_rms_mm"], "RMS distance [mm], nominal robot"),
        ("after", fitted["rms_mm"], "RMS distance [mm], calibrated, fitted rows"),
    ]
    sections = [Section(
        "Scatter of the ball in its sockets", "Distance of the predicted ball centre from its mean"
        " position in the socket (lower is better), and distances of neighbouring sockets.",
        picture=picture,
    )]  # fmt: skip
    if judged:
        figures.append(("after", judged["rms_mm"], "RMS distance [mm], calibrated, held-out rows"))
        rows = [
            (name, f"{one['nominal_rms_mm']:.3f}", f"{one['rms_mm']:.3f}",
             f"{one['rms_without_outliers_mm']:.3f}", one["model"])
            for name, one in judged["parts"].items()
        ]  # fmt: skip
        sections.append(Section(
            "Held-out places", "RMS distance of the ball from its mean position in the socket"
            " (lower is better), predicted by a calibration on all other places.",
            ("place", "nominal [mm]", "calibrated [mm]", "calibrated, without outliers [mm]",
             "joint model"), rows, "-nnn",
        ))  # fmt: skip
    notes = [*(f"{o['socket']}, row {o['row']}: {o['distance_mm']:.2f} mm from its socket, excluded"
               " from the fit" for o in document["outliers"]), *document["notes"],
             f"data: {document['data']}"]  # fmt: skip
    sections += [_parameter_section(document), _combination_section(document),
                 Section("Notes", "Excluded samples and remarks.", notes=notes)]  # fmt: skip
    write_sections(
        path, f"hydrotele {hydrotele.__version__} - closed-chain calibration from joint angles",
        f"{document['robot']}: {len(document['places'])} places,"
        f" {sum(document['rows'].values())} postures",
        f"Joint model: {document['model']}. Noise standard deviation of a coordinate:"
        f" {document['noise_mm']:.3f} mm. Status of the fit: {document['status']}.",
        sections, [(kind, f"{value:.3f}", what) for kind, value, what in figures],
    )  # fmt: skip


def _parameter_section(document: dict[str, Any]) -> Section:
    rows = []
    for one in document["parameters"]:
        unit, factor = _display_unit(one["unit"])
        reach = "" if one["std"] is None else f"{0.5 * factor * (one['high'] - one['low']):.2g}"
        told = {"full": "yes", "combination": "in a combination"}.get(one["identifiability"], "no")
        rows.append((one["name"], f"{factor * one['value']:.4g}", reach, unit, told))
    return Section(
        "Parameters", "t and r: displacement along and rotation about the axes of a joint frame;"
        " z is the joint axis, and rz is the offset of the joint angle. sag: compliance of a joint"
        " under a weight at a distal location. sine and cosine: encoder error with a period of one"
        " revolution.",
        ("parameter", "value", "95 % +-", "unit", "identifiable"), rows, "-nn",
    )  # fmt: skip


def _combination_section(document: dict[str, Any]) -> Section:
    units = {one["name"]: one["unit"] for one in document["parameters"]}
    rows = []
    for one in document["identifiable_combinations"]:
        unit, factor = _display_unit(units[one["text"].split()[0]])
        reach = f"{0.5 * factor * (one['high'] - one['low']):.2g}"
        rows.append((one["text"], f"{factor * one['value']:.4g}", reach, unit))
    return Section(
        "Identifiable parameters and combinations", "A parameter or combination is identifiable if"
        " its standard deviation at the estimated noise is below half of its expected size. The"
        " values of the single members of a combination follow from their expected sizes, not from"
        " the data.",
        ("parameter or combination", "value", "95 % +-", "unit"), rows, "-nn",
        notes=(f"not identifiable: {', '.join(document['not_identifiable']) or 'none'}",),
    )  # fmt: skip


def _display_unit(unit: str) -> tuple[str, float]:
    return {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}.get(unit, (unit, 1.0))
