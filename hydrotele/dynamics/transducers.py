"""Sensors with a first-order lag, along what an ideal sensor would show over a row of a log."""

from hydrotele.core.compiled import lean
from hydrotele.machine.noise import first_order


@lean
def show_late(model, c):
    """Whether a channel shows the past: through a delay or a first-order lag.

    Args:
        model: Model.
        c: channel.

    Returns:
        bool.

    Source: nominal model, "Sensors".
    """
    return model.lag[c] > 0.0 or model.time_constant[c] > 0.0


@lean
def follow_channel(trail, c, ratio, shown):
    """Replace what an ideal sensor shows over a row by what one with a first-order lag shows.

    Args:
        trail: (k + 1, c) as `integrate.advance` writes it, of k steps; column c is replaced
            [channel's unit].
        c: channel.
        ratio: length of a step over the time constant, scalar [1].
        shown: what the sensor shows at the row's start, scalar [channel's unit].

    Returns:
        What it shows at the row's end, scalar [channel's unit].

    Source: `noise.first_order`, between steps straight.
    """
    before = trail[0, c]
    trail[0, c] = shown
    for k in range(1, len(trail)):
        now = trail[k, c]
        shown = first_order(shown, before, now, ratio)
        trail[k, c] = shown
        before = now
    return shown


@lean
def follow_trail(model, trail, h, shown):
    """`follow_channel` for every channel with a first-order lag.

    Args:
        model: Model.
        trail: (k + 1, c) as `integrate.advance` writes it, of k steps; changed in place.
        h: step, scalar [s].
        shown: (c,) what the sensors show at the row's start, then at its end; changed in place.

    Returns:
        Nothing.

    Source: `follow_channel`.
    """
    for c in range(len(model.time_constant)):
        if model.time_constant[c] > 0.0:
            shown[c] = follow_channel(trail, c, h / model.time_constant[c], shown[c])
