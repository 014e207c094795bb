"""What the package uses of dm_control, imported so that it draws without a window.

dm_control reads MUJOCO_GL when it is imported; where that is not set it tries a window library, and warns. So the
library is chosen first. Where nothing draws, MUJOCO_GL becomes "off": dm_control then loads, and refuses to render.
"""

import os

from armperturb.envs.render.gl import choose_backend, require_simulator, stay_last

require_simulator()
try:
    choose_backend()
except RuntimeError:
    os.environ["MUJOCO_GL"] = "off"

from dm_control import composer as composer  # noqa: E402
from dm_control import mjcf as mjcf  # noqa: E402
from dm_control.composer.observation import observable as observable  # noqa: E402

stay_last()
