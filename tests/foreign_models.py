"""Arms in MJCF that the package knows nothing of, with parameters that are known."""

import numpy as np

TWO_LINK = """
<mujoco model="two_link">
  <worldbody>
    <body name="upper" pos="0.1 -0.2 1.0" euler="0 0 40">
      <joint name="q1" axis="0 0 1"/>
      <inertial pos="0.1364 0 0" mass="2.0" diaginertia="0.001 0.0197 0.0197"/>
      <body name="fore" pos="0.31 0 0" euler="0 0 85">
        <joint name="q2" axis="0 0 1"/>
        <inertial pos="0.187 0 0" mass="1.5" diaginertia="0.001 0.0156 0.0156"/>
        <site name="palm" pos="0.34 0 0"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="s" stiffness="75" damping="2.4"><joint joint="q1" coef="1"/></fixed>
    <fixed name="se" stiffness="28" damping="0.9"><joint joint="q1" coef="1"/><joint joint="q2" coef="1"/></fixed>
    <fixed name="e" stiffness="60" damping="1.7"><joint joint="q2" coef="1"/></fixed>
  </tendon>
</mujoco>
"""
"""Rigid segments that turn about the vertical on springs and dampers."""

STIFFNESS, DAMPING = np.array([[103.0, 28.0], [28.0, 88.0]]), np.array([[3.3, 0.9], [0.9, 2.6]])
"""Of `TWO_LINK`, (joint, joint)."""


def two_link_inertia() -> np.ndarray:
    """Mass matrix of `TWO_LINK` in its posture [kg m^2], (joint, joint), by Lagrange's equations of two segments."""
    elbow = 0.0156 + 1.5 * 0.187**2
    coupled = elbow + 1.5 * 0.31 * 0.187 * np.cos(np.radians(85.0))
    shoulder = 0.0197 + 2.0 * 0.1364**2 + 1.5 * 0.31**2 + 2 * coupled - elbow
    return np.array([[shoulder, coupled], [coupled, elbow]])


def _pair(name: str, arms: tuple[float, float]) -> tuple[str, str]:
    """Tendons and muscles of a pair with moment arms at shoulder and elbow [m]."""
    tendons = muscles = ""
    for side, sign in (("flexor", 1.0), ("extensor", -1.0)):
        joints = "".join(
            f'<joint joint="{joint}" coef="{-sign * arm}"/>'
            for joint, arm in zip(("q1", "q2"), arms, strict=True)
            if arm
        )
        tendons += f'<fixed name="{name}_{side}">{joints}</fixed>'
        muscles += (
            f'<muscle name="{name}_{side}" tendon="{name}_{side}" force="900" lengthrange="-0.06 0.06" '
            'range="0.5 1.3" fpmax="0.1"/>'
        )
    return tendons, muscles


_PAIRS = [_pair("s", (0.04, 0.0)), _pair("se", (0.03, 0.03)), _pair("e", (0.0, 0.03))]

MUSCLE_ARM = f"""
<mujoco model="muscle_arm">
  <worldbody>
    <body name="upper" pos="0 0 1" euler="0 0 30">
      <joint name="q1" axis="0 0 1" damping="0.5" range="-90 90"/>
      <inertial pos="0.14 0 0" mass="2.0" diaginertia="0.001 0.02 0.02"/>
      <body name="fore" pos="0.31 0 0" euler="0 0 90">
        <joint name="q2" axis="0 0 1" damping="0.5" range="-80 60"/>
        <inertial pos="0.18 0 0" mass="1.5" diaginertia="0.001 0.015 0.015"/>
        <body name="hand" pos="0.34 0 0" euler="0 0 10">
          <joint name="wrist" axis="0 1 0" damping="0.05"/>
          <inertial pos="0.02 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
          <site name="palm" pos="0.05 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>{"".join(tendons for tendons, _ in _PAIRS)}</tendon>
  <actuator>{"".join(muscles for _, muscles in _PAIRS)}</actuator>
</mujoco>
"""
"""Six muscles of MuJoCo's kind, of 900 N each, and a wrist that can leave the plane."""
