"""Write models/iwr/iwr.xml and iwr.png from models/iwr/iwr.yaml.

Usage: MUJOCO_GL=egl python tools/release/iwr_model.py
"""

from pathlib import Path

import matplotlib.image
import mujoco
import numpy as np

from hydrotele.kinematics.hybrid_robot import (
    PlatformPose,
    euler_to_rotation,
    home_pose,
    leg_readings,
    load_hybrid,
)
from hydrotele.simulate.hybrid_mechanism import build_hybrid_mechanism, solve_mechanism_pose

FOLDER = Path(__file__).resolve().parents[2] / "models" / "iwr"
JOINTS = np.array([0.9, 0.05, -0.35, 0.12])  # m and rad, of the picture
LOCAL = np.array([0.05, -0.03, 0.03]), np.array([0.15, -0.10, 0.1])  # m and rad, of the platform


def main() -> None:
    robot = load_hybrid("iwr")
    spec = build_hybrid_mechanism(robot)
    text = spec.to_xml()
    note = "<!-- Written by tools/release/iwr_model.py from iwr.yaml; a test compares the two. -->\n"
    (FOLDER / "iwr.xml").write_text(note + text, encoding="utf-8")
    scene = build_hybrid_mechanism(robot)
    scene.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=64, height=384,
                      builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, rgb1=[0.93, 0.95, 0.97],
                      rgb2=[0.75, 0.80, 0.85])  # fmt: skip
    scene.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[8, 8, 0.1],
                             rgba=[0.80, 0.81, 0.80, 1], contype=0, conaffinity=0)  # fmt: skip
    for place, strength in (((2, -3, 5), 0.45), ((-1, 3, 4), 0.25)):
        scene.worldbody.add_light(
            pos=place,
            dir=[-p for p in place],
            diffuse=[strength] * 3,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        )
    model = scene.compile()
    data = mujoco.MjData(model)
    home = home_pose(robot, JOINTS)
    pose = PlatformPose(home.rotation @ euler_to_rotation(LOCAL[1]),
                home.position + home.rotation @ LOCAL[0])  # fmt: skip
    solve_mechanism_pose(model, data, robot, JOINTS, leg_readings(robot, JOINTS, pose))
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance = [1.1, -0.1, 0.8], 2.9
    camera.azimuth, camera.elevation = 128.0, -18.0
    with mujoco.Renderer(model, 900, 1200) as renderer:
        renderer.update_scene(data, camera)
        matplotlib.image.imsave(FOLDER / "iwr.png", renderer.render())


if __name__ == "__main__":
    main()
