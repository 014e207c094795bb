"""The rig as dm_control composer entities: a person's arm, the manipulator, and the room in which one grips the other.

They are made of the package's MJCF files and of the numbers in `build_spec`, so what they compile to is what
`build_model` compiles: joints, motors and sensors in the same order, and trajectories the same to the last bit. Names
have that of the entity before them, as in "arm/shoulder"; the room's own, such as those of its cameras, do not.
"""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree

import mujoco
import numpy as np

from armperturb.environment import TIMESTEP, Environment, Strap
from armperturb.envs.learning.dm import composer, mjcf, observable
from armperturb.models import rig
from armperturb.subject import Subject

NUMBERS = {
    "joint": ("ref", "springref", "stiffness", "damping", "armature", "axis", "range"),
    "geom": ("pos", "fromto", "size"),
    "site": ("pos",),
    "tendon": ("stiffness", "damping", "springlength"),
    "actuator": ("delay", "nsample"),
}
"""What `build_spec` may set, by kind of element; of bodies it has other names than MJCF."""


class _Part(composer.Entity):
    """What one of the package's MJCF files describes."""

    FILE: Path

    SENSES: ClassVar[Mapping[str, Callable[[Any, mjcf.Physics], np.ndarray]]]
    """Name of each observable to what reads it, (component,)."""

    def _build(self, spec: mujoco.MjSpec) -> None:
        """Build the entity.

        Args:
          spec: the rig that it is part of, from `build_spec`.
        """
        self._mjcf_model = _model(self.FILE, spec)

    def _build_observables(self) -> composer.Observables:
        observables = composer.Observables(self)
        for name, read in self.SENSES.items():
            # Copies: what pads a buffer would otherwise be a view of the moving state.
            copied = observable.Generic(lambda physics, read=read: np.array(read(self, physics)))
            observables.add_observable(name, copied, enabled=False)
        return observables

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The model."""
        return self._mjcf_model


class ArmEntity(_Part):
    """A seated person: the arm with its muscles, the motors of its reflexes and the sensors of its joint angles.

    Its observables are the angles [rad] and angular velocities [rad/s] of shoulder and elbow.
    """

    FILE = rig.ARM_XML
    SENSES: ClassVar = {
        "joint_angles": lambda arm, physics: physics.bind(arm.joints).qpos,
        "joint_velocities": lambda arm, physics: physics.bind(arm.joints).qvel,
    }

    @property
    def joints(self) -> list[mjcf.Element]:
        """Hinges: shoulder, elbow."""
        return [self._mjcf_model.find("joint", name) for name in rig.JOINTS]

    @property
    def biarticular(self) -> mjcf.Element:
        """Tendon of the two-joint muscles."""
        return self._mjcf_model.find("tendon", rig.BIARTICULAR)

    @property
    def reflexes(self) -> list[mjcf.Element]:
        """Motors of both joints; `ctrl` is the torque [Nm], which acts after the neural delay."""
        return [self._mjcf_model.find("actuator", name) for name in rig.REFLEXES]

    @property
    def grip(self) -> list[mjcf.Element]:
        """Tendons from the hand to what it holds, in the order of `GRIP`; none before it holds something."""
        return [tendon for name in rig.GRIP if (tendon := self._mjcf_model.find("tendon", name)) is not None]

    def hold(self, manipulator: "ManipulatorEntity", spec: mujoco.MjSpec) -> None:
        """Grip the handle of a manipulator; both must then be attached to the same model.

        Args:
          manipulator: whose handle.
          spec: the rig that both are part of, from `build_spec`.
        """
        # The arm has them, so that its own tendons come first: in what order forces are summed shows in the last bit.
        for tendon in _template().tendon.all_children():
            grip = _copy(tendon, self._mjcf_model.tendon)
            for end in grip.site:
                if self._mjcf_model.find("site", end.site) is None:
                    end.site = manipulator.mjcf_model.find("site", end.site)
        _set_numbers(self._mjcf_model, spec)


class ManipulatorEntity(_Part):
    """The manipulator with its table, the sensors of its displacement and the strain gauge.

    Its observables are the displacement of the handle from its start [m], its velocity [m/s], and the force that it
    exerts on the hand [N] at the start of the last physics step: MuJoCo has it on the way to the next state only.
    """

    FILE = rig.MANIPULATOR_XML
    SENSES: ClassVar = {
        "handle_displacement": lambda manipulator, physics: physics.bind(manipulator.slides).qpos,
        "handle_velocity": lambda manipulator, physics: physics.bind(manipulator.slides).qvel,
        # Through a binding, dm_control might compute it anew for the next state with the controls of the last step.
        "hand_force": lambda manipulator, physics: physics.data.sensordata[physics.bind(manipulator.gauge).adr :][:2],
    }

    @property
    def slides(self) -> list[mjcf.Element]:
        """Slides of the handle: x, y; perturbations act on them."""
        return [self._mjcf_model.find("joint", name) for name in rig.SLIDES]

    @property
    def gauge(self) -> mjcf.Element:
        """Force sensor: what the handle exerts on the hand [N], world axes (x, y, z)."""
        return self._mjcf_model.find("sensor", rig.STRAIN_GAUGE)


class Rig(composer.Arena):
    """The room, and in it a person's arm that grips the manipulator, at rest at the start posture.

    Attributes:
      arm: the person.
      manipulator: what the hand holds.
    """

    def _build(
        self,
        subject: Subject,
        environment: Environment = Environment(),  # noqa: B008
        *,
        timestep: float = TIMESTEP,
        rope: str = "ideal",
        strap: Strap | None = None,
    ) -> None:
        """Build the entity; arguments and errors as in `build_model`.

        Args:
          subject: whose arm, grip and delays.
          environment: virtual mass, spring, damper and workspace of the manipulator.
          timestep: physics step [s].
          rope: "ideal" or "pendulum".
          strap: what lets the shoulder move; None holds it in place.
        """
        spec = rig.build_spec(subject, environment, timestep=timestep, rope=rope, strap=strap)
        self._mjcf_root = _room()
        self._mjcf_root.option.timestep = spec.option.timestep
        for section in ("tendon", "actuator", "sensor"):
            for element in getattr(self._mjcf_root, section).all_children():
                element.remove()  # the entities have them
        self.arm, self.manipulator = ArmEntity(spec), ManipulatorEntity(spec)
        self.attach(self.arm)
        self.attach(self.manipulator)
        self.arm.hold(self.manipulator, spec)


def _room() -> mjcf.RootElement:
    """What is in the rig's own file; arm and manipulator, to which it refers, are not."""
    tree = ElementTree.parse(rig.RIG_XML).getroot()
    for include in tree.findall("include"):
        tree.remove(include)
    return mjcf.from_xml_string(ElementTree.tostring(tree, encoding="unicode"))


_template = functools.cache(_room)
"""A room to copy from."""


def _model(path: Path, spec: mujoco.MjSpec) -> mjcf.RootElement:
    """A file's model with the rig's motors and sensors that are on it, and the numbers of a spec."""
    model, room = mjcf.from_path(str(path)), _template()
    for section, parent in ((room.actuator, model.actuator), (room.sensor, model.sensor)):
        for element in section.all_children():
            kind = "joint" if hasattr(element, "joint") else "site"
            if model.find(kind, getattr(element, kind)) is not None:
                _copy(element, parent)
    _set_numbers(model, spec)
    return model


def _copy(element: mjcf.Element, parent: mjcf.Element) -> mjcf.Element:
    copied = parent.add(element.tag, **element.get_attributes())
    for child in element.all_children():
        _copy(child, copied)
    return copied


def _set_numbers(model: mjcf.RootElement, spec: mujoco.MjSpec) -> None:
    """Take over all numbers that belong to a person or an environment, and leave out the joints that the spec has not.

    MJCF is text with 17 digits, which is every bit.
    """
    for element in model.find_all("body"):
        twin = spec.body(element.name)
        element.pos = twin.pos
        if element.euler is not None:
            element.euler = twin.alt.euler
        if element.inertial is not None:
            element.inertial.pos, element.inertial.mass = twin.ipos, twin.mass
    for kind, attributes in NUMBERS.items():
        for element in model.find_all(kind):
            twin = getattr(spec, kind)(element.name)
            if twin is None:
                element.remove()
                continue
            for attribute in attributes:
                value = getattr(twin, attribute)
                if np.isnan(value).any() or (attribute == "pos" and getattr(element, "fromto", None) is not None):
                    continue  # a geom has either a position or two ends
                setattr(element, attribute, value)
