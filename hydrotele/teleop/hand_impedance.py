"""Mass, damping and stiffness of an operator's hand for a grip, a posture of the arm and co-contraction."""

import math

import numpy as np

from hydrotele.core.datafile import suggest_valid_name as suggest_name
from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import HandImpedance, Joystick
from hydrotele.scenario.teleoperation import OperatorSettings
from hydrotele.teleop.operator_parameters import (
    ArmParameters,
    OperatorFile,
    load_perception_file,
    make_scenario_operator,
)


def attach_operator_hand(joystick: Joystick, perception: OperatorSettings, folder: str = "") -> Joystick:
    """Return a copy of the joystick with the hand impedance of the scenario's operator.

    A grip replaces the hand of the joystick file. A posture sets its horizontal mass and stiffness
    ellipses. Co-contraction multiplies its stiffness by a factor, at the same damping ratio.

    Args:
        joystick: the joystick.
        perception: operator settings of the scenario (key `perception`).
        folder: folder of the scenario, to which the path of the operator file is relative.

    Returns:
        The joystick with the operator's hand.

    Raises:
        InputError: the grip or posture is not known, the posture is out of the arm's reach, or the
            file is invalid.

    Source: `arm_impedance` for the posture; Hogan 1984 for co-contraction.
    """
    file, him = load_perception_file(perception, folder), make_scenario_operator(perception, folder)
    hand = joystick.hand
    if perception.grip:
        if perception.grip not in file.grips:
            message = f"{perception.grip!r}; {suggest_name(perception.grip, file.grips)}"
            raise InputError("pilot.perception.grip", message)
        hand = file.grips[perception.grip]
    factor = 1.0 + (him.cocontraction_stiffness_factor - 1.0) * min(1.0, him.cocontraction)
    if perception.posture:
        if perception.posture not in file.postures:
            message = f"{perception.posture!r}; {suggest_name(perception.posture, file.postures)}"
            raise InputError("pilot.perception.posture", message)
        hand = apply_posture(hand, file, perception.posture)
    return joystick.model_copy(update={"hand": scale_hand_stiffness(hand, factor)})


def apply_posture(hand: HandImpedance, file: OperatorFile, posture: str) -> HandImpedance:
    """Return a copy of a hand with the horizontal mass and stiffness ellipses of an arm's posture.

    The arm's mass and stiffness matrices in this posture are divided by the square root of the
    determinant that they have in the reference posture. They are stored as `mass_shape` and
    `stiffness_shape` of the hand, factors on its mass and stiffness.

    Args:
        hand: hand with the grip's parameters.
        file: file with the arm and the posture.
        posture: name of the posture.

    Returns:
        The hand; its vertical and rotational impedance stays that of the grip.

    Raises:
        InputError: the posture is out of the arm's reach.
    """
    arm = file.arm
    assert arm  # the default file has one
    shapes = []
    for matrix, usual in zip(
        arm_impedance(arm, file.postures[posture]),
        arm_impedance(arm, file.postures[arm.reference_posture]), strict=True,
    ):  # fmt: skip
        shape = matrix / math.sqrt(np.linalg.det(usual))
        shapes.append((float(shape[0, 0]), float(shape[0, 1]), float(shape[1, 1])))
    return hand.model_copy(update={"mass_shape": shapes[0], "stiffness_shape": shapes[1]})


def arm_impedance(arm: ArmParameters, hand_position: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mass and stiffness of an arm at its hand, in the horizontal plane.

    A matrix A of the joints becomes `J^-T A J^-1` at the hand, with the Jacobian J of the hand's
    position by the joint angles.

    Args:
        arm: two links, with the elbow to the right of the line from shoulder to hand.
        hand_position: hand position, ahead and to the left of the shoulder [m].

    Returns:
        (2, 2) mass [kg] and stiffness [N/m], ahead and to the left.

    Raises:
        InputError: the position is out of reach.

    Source: Hogan 1985 (impedance in other coordinates); Mussa-Ivaldi, Hogan and Bizzi 1985.

    >>> from hydrotele.teleop.operator_parameters import load_operator_file
    >>> file = load_operator_file()
    >>> assert file.arm
    >>> arm_impedance(file.arm, (0.4, 0.0))[1].round().tolist()
    [[499.0, 22.0], [22.0, 184.0]]
    """
    (upper, fore), (x, y) = arm.length, hand_position
    bend = (x * x + y * y - upper**2 - fore**2) / (2.0 * upper * fore)
    if not abs(bend) < 1.0:
        message = f"a hand at {x:g}, {y:g} m is out of reach of links of {upper:g} and {fore:g} m"
        raise InputError("postures", message)
    elbow = math.acos(bend)
    far = fore * math.sin(elbow)
    shoulder = math.atan2(y, x) - math.atan2(far, upper + fore * bend)
    along, across = fore * math.cos(shoulder + elbow), fore * math.sin(shoulder + elbow)
    jacobian = np.array([[-y, -across], [x, along]])
    (m1, m2), (i1, i2) = arm.mass, arm.inertia
    second = i2 + m2 * (0.5 * fore) ** 2
    both = second + 0.5 * m2 * upper * fore * bend
    first = i1 + m1 * (0.5 * upper) ** 2 + m2 * upper**2 + 2.0 * both - second
    mass = np.array([[first, both], [both, second]])
    k_shoulder, k_both, k_elbow = arm.joint_stiffness
    stiffness = np.array([[k_shoulder, k_both], [k_both, k_elbow]])
    inverse = np.linalg.inv(jacobian)
    return inverse.T @ mass @ inverse, inverse.T @ stiffness @ inverse


def scale_hand_stiffness(hand: HandImpedance, factor: float) -> HandImpedance:
    """Return a copy of a hand with `factor` times the stiffness and the same damping ratio.

    The damping is multiplied by the square root of `factor`; the mass is kept. Antagonist muscles
    that contract together add stiffness and damping but no force (Hogan 1984).

    Args:
        hand: mass [kg], damping [N s/m] and stiffness [N/m].
        factor: factor on the stiffness.

    Returns:
        The stiffer hand.
    """
    root = math.sqrt(factor)
    return hand.model_copy(update={
        "stiffness": factor * hand.stiffness, "damping": root * hand.damping,
        "rotation_stiffness": factor * hand.rotation_stiffness,
        "rotation_damping": root * hand.rotation_damping,
    })  # fmt: skip
