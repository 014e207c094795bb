"""The MJCF files of arm and manipulator, and the function that compiles them for a person."""

from armperturb.models.rig import ANGLE_SENSORS as ANGLE_SENSORS
from armperturb.models.rig import ARM_XML as ARM_XML
from armperturb.models.rig import BIARTICULAR as BIARTICULAR
from armperturb.models.rig import GRIP as GRIP
from armperturb.models.rig import HAND_SITE as HAND_SITE
from armperturb.models.rig import HANDLE_SENSORS as HANDLE_SENSORS
from armperturb.models.rig import JOINTS as JOINTS
from armperturb.models.rig import MANIPULATOR_XML as MANIPULATOR_XML
from armperturb.models.rig import REFLEXES as REFLEXES
from armperturb.models.rig import RIG_XML as RIG_XML
from armperturb.models.rig import ROPE as ROPE
from armperturb.models.rig import ROPES as ROPES
from armperturb.models.rig import SLIDES as SLIDES
from armperturb.models.rig import STRAIN_GAUGE as STRAIN_GAUGE
from armperturb.models.rig import STRAP as STRAP
from armperturb.models.rig import build_model as build_model
from armperturb.models.rig import build_spec as build_spec
from armperturb.models.rig import history_length as history_length
