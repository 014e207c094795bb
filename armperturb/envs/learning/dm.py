"""What we use of dm_control, imported with the library that draws here: by itself dm_control tries a window first."""

from armperturb.envs.render.gl import load_dm_control

load_dm_control()

from dm_control import composer as composer  # noqa: E402
from dm_control import mjcf as mjcf  # noqa: E402
from dm_control.composer.observation import observable as observable  # noqa: E402
