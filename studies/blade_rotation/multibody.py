"""The grader that holds the blade, as a multibody system in MuJoCo: chassis, lifts, circle with the PH54, tilt, blade.

    chassis --(along x, its drive)-- drawbar --(heave, roll; two lifts)-- circle --(yaw; PH54)-- blade --(pitch; tilt)

The study had blade and floor in RecurDyn, the blade driven at 1 m/s. What hangs between chassis and blade here is the
1/4-scale machine of its section 3: two Electrak HD of 1,700 N, one Electrak MD of 500 N, a PH54-200-S500-R of 44.7 N m.
It prints no masses and no stiffness; what is assumed says so.

Frame as in ``case.py``; the blade's axis is the vertical through the middle of its cutting edge. Forces and moments of
the soil are taken about the axis' foot.

Table 1 is RecurDyn's contact of blade and floor, which matters where the cutting edge is pressed down onto it.
Stiffness: 10,000, taken in its default unit, N/mm. Damping: 10,000 N s/mm would be some hundred times critical, which
says no more than that nothing bounces; it is critical here. Friction: 0.37 from 1 m/s of slip on, less below (its
static threshold speed); the dynamic threshold of 1.5 m/s and what comes beyond are never reached.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from graderd.simulator.servo.motion import PlantSettings
from graderd.studies.blade_rotation.case import NEWTON_G_M_PER_S2, QUARTER_SIZE, BladeShape

F64 = npt.NDArray[np.float64]

SERVO_LIMIT_NM: Final = 44.7
"""Continuous torque of the PH54-200-S500-R, by its maker and by the study's section 3.1."""
LIFT_LIMIT_N: Final = 1700.0
TILT_LIMIT_N: Final = 500.0
"""What the study's section 3.1 prints of the actuators."""
TABLE_1_STIFFNESS_N_PER_M: Final = 10_000.0 * 1e3
TABLE_1_FRICTION: Final = 0.37
TABLE_1_STATIC_M_PER_S: Final = 1.0
STEP_S: Final = 2.5e-4
"""Time step of the multibody system, at most."""


@dataclass(frozen=True, slots=True)
class Wrench:
    """Force (N) and moment (N m) of the soil on the blade, about the foot of its axis, in the travel's frame."""

    force_n: tuple[float, float, float] = (0.0, 0.0, 0.0)
    moment_nm: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Pose:
    """The foot of the blade's axis (m) and its yaw (rad), and how fast they change."""

    place_m: tuple[float, float, float]
    yaw_rad: float
    velocity_m_per_s: tuple[float, float, float]
    yaw_rad_per_s: float


@dataclass(frozen=True, slots=True)
class Machine:
    """Masses, stiffness and limits. The defaults are the 1/4-scale machine.

    Assumed: the blade's mass, which gives the 0.8 kg m2 about the axis that the rig's servo has; the drawbar's and the
    chassis'; an actuator that gives way by 1 mm under its greatest load; a damping of a tenth of critical.
    """

    blade: BladeShape = QUARTER_SIZE
    blade_kg: float = 9.6
    drawbar_kg: float = 8.0
    chassis_kg: float = 150.0
    drive_n_s_per_m: float = 2e5
    lift_spacing_m: float = 0.80
    """As the rig has it (``graderd.simulator.grader.blade``); so the tilt's arm, 0.30 degrees for each mm."""
    lift_n_per_m: float = LIFT_LIMIT_N / 1e-3
    tilt_n_per_m: float = TILT_LIMIT_N / 1e-3
    tilt_arm_m: float = 1e-3 / math.radians(0.30)
    damping_ratio: float = 0.1
    servo_limit_nm: float = SERVO_LIMIT_NM
    servo_bandwidth_hz: float = PlantSettings().bandwidth_hz
    servo_integral_s: float = PlantSettings().integral_s
    servo_friction_nm: float = PlantSettings().friction_nm
    stops_rad: float = math.radians(75.0)
    """Ends of the circle's turn."""

    @classmethod
    def of(cls, blade: BladeShape) -> Machine:
        """The machine for a blade of other length: masses grow with the cube of the length, stiffness with its square
        (so that deflections grow as the machine does), the actuators' limits stay those of the 1/4-scale machine."""
        base, scale = cls(), blade.length_m / cls().blade.length_m
        return replace(
            base,
            blade=blade,
            blade_kg=base.blade_kg * scale**3,
            drawbar_kg=base.drawbar_kg * scale**3,
            chassis_kg=base.chassis_kg * scale**3,
            drive_n_s_per_m=base.drive_n_s_per_m * scale**2,
            lift_spacing_m=base.lift_spacing_m * scale,
            lift_n_per_m=base.lift_n_per_m * scale**2,
            tilt_n_per_m=base.tilt_n_per_m * scale**2,
            tilt_arm_m=base.tilt_arm_m * scale,
        )

    @property
    def yaw_inertia_kg_m2(self) -> float:
        """Of the blade about its axis, as a thin rod's."""
        return self.blade_kg * self.blade.length_m**2 / 12.0


READINGS: Final = (
    "x",
    "y",
    "z",
    "roll",
    "pitch",
    "yaw",
    "yaw_wanted",
    "speed",
    "load_nm",
    "servo_nm",
    "lift_left_n",
    "lift_right_n",
    "tilt_n",
    "draft_n",
    "side_draft_n",
    "floor_n",
)
"""What a multibody step tells: place (m), attitude (rad), speed (m/s); the soil's moment about the axis and the servo's
torque (N m); forces of lifts and tilt (N, positive: the actuator pushes the blade down, or its top forward); what the
drawbar pulls the chassis with, back (draft) and to the left (side draft); the floor's force on the cutting edge."""


class Holder(Protocol):
    """What holds the blade."""

    @property
    def pose(self) -> Pose:
        """Where it is now."""
        ...

    def advance(self, wrench: Wrench, yaw_rad: float, duration_s: float) -> Pose:
        """Let time pass under a steady wrench, the servo's goal moving to ``yaw_rad`` steadily; where the blade is."""
        ...

    def readings(self) -> F64:
        """:data:`READINGS` now."""
        ...

    def state(self) -> list[float]:
        """All that goes on from one step to the next."""
        ...

    def restore(self, state: list[float]) -> None:
        """Go on from :meth:`state`."""
        ...


class Multibody:
    """A machine that travels at a speed set, its blade at rest on its holders at first.

    Args:
        machine: what it is made of.
        pose: where the blade is at first; its velocity along x is the drive's for good.
    """

    def __init__(self, machine: Machine, pose: Pose) -> None:
        self.machine = machine
        self._model = mujoco.MjModel.from_xml_string(_mjcf(machine, pose))
        self._data = mujoco.MjData(self._model)
        self._wanted_rad = pose.yaw_rad
        self._integral_nm = 0.0
        self._wrench, self._floor_n = Wrench(), 0.0
        self._speed = pose.velocity_m_per_s[0]
        self._balance(pose)

    def _balance(self, pose: Pose) -> None:
        """Springs that carry the weight where the blade is, everything moving on as one."""
        model, data = self._model, self._data
        data.qpos[:] = (0.0, 0.0, 0.0, pose.yaw_rad, 0.0)
        data.qvel[:] = (self._speed, 0.0, 0.0, 0.0, 0.0)
        data.ctrl[0] = self._speed
        mujoco.mj_forward(model, data)
        weight = data.qfrc_bias - data.qfrc_passive
        model.tendon_lengthspring[:] = weight[1] / (2.0 * self.machine.lift_n_per_m)
        model.qpos_spring[4] = weight[4] / model.jnt_stiffness[4]
        mujoco.mj_forward(model, data)

    def advance(self, wrench: Wrench, yaw_rad: float, duration_s: float) -> Pose:
        """See :class:`Holder`."""
        model, data = self._model, self._data
        steps_n = max(1, math.ceil(duration_s / STEP_S - 1e-9))
        model.opt.timestep = duration_s / steps_n
        rate = (yaw_rad - self._wanted_rad) / duration_s
        self._wrench = wrench
        for _ in range(steps_n):
            self._wanted_rad += rate * model.opt.timestep
            data.ctrl[0] = self._speed
            data.ctrl[1] = self._servo_nm(rate, model.opt.timestep)
            self._load(wrench)
            mujoco.mj_step(model, data)
            self._floor_n = self._pressed_n()
        self._wanted_rad = yaw_rad
        mujoco.mj_forward(model, data)
        return self.pose

    def _load(self, wrench: Wrench) -> None:
        """The soil's wrench and the floor's friction, moved from the axis' foot to the blade's centre of mass."""
        data, force = self._data, np.array(wrench.force_n)
        force[0] -= self._floor_n * _friction(data.qvel[0])
        arm = data.site("foot").xpos - data.body("blade").xipos
        blade = self._model.body("blade").id
        data.xfrc_applied[blade, :3] = force
        data.xfrc_applied[blade, 3:] = np.array(wrench.moment_nm) + np.cross(arm, force)

    def _servo_nm(self, rate: float, dt_s: float) -> float:
        """The PH54's position loop as the rig's servo has it: spring and damper of its bandwidth, an integral that
        stands still while the torque is at its limit."""
        m, data = self.machine, self._data
        omega = 2.0 * math.pi * m.servo_bandwidth_hz
        error, slip = self._wanted_rad - data.qpos[3], rate - data.qvel[3]
        inertia = m.yaw_inertia_kg_m2
        asked = inertia * (omega * omega * error + 2.0 * omega * slip) + self._integral_nm
        given = max(-m.servo_limit_nm, min(m.servo_limit_nm, asked))
        if given == asked:
            self._integral_nm += inertia * omega * omega * error * dt_s / m.servo_integral_s
        return float(given)

    def _pressed_n(self) -> float:
        force = np.zeros(6)
        total = 0.0
        for number in range(self._data.ncon):
            mujoco.mj_contactForce(self._model, self._data, number, force)
            total += float(force[0])
        return total

    @property
    def pose(self) -> Pose:
        """The blade's, now."""
        data = self._data
        velocity = np.zeros(6)
        foot = self._model.site("foot").id
        mujoco.mj_objectVelocity(self._model, data, mujoco.mjtObj.mjOBJ_SITE, foot, velocity, 0)
        x, y, z = data.site_xpos[foot].tolist()
        vx, vy, vz = velocity[3:].tolist()
        return Pose((x, y, z), float(data.qpos[3]), (vx, vy, vz), float(data.qvel[3]))

    def readings(self) -> F64:
        """See :data:`READINGS`."""
        data, m, pose = self._data, self.machine, self.pose
        stretch = data.ten_length - self._model.tendon_lengthspring[:, 0]
        lifts = -self._model.tendon_stiffness * stretch - self._model.tendon_damping * data.ten_velocity
        tilt = self._model.jnt_stiffness[4] * (self._model.qpos_spring[4] - data.qpos[4])
        drawbar = data.sensor("drawbar").data
        return np.array(
            (
                *pose.place_m, data.qpos[2], data.qpos[4], data.qpos[3], self._wanted_rad, data.qvel[0],
                self._wrench.moment_nm[2], data.actuator_force[1], -lifts[0], -lifts[1], tilt / m.tilt_arm_m,
                drawbar[0], -drawbar[1], self._floor_n,
            )
        )  # fmt: skip

    def state(self) -> list[float]:
        """All that goes on from one step to the next."""
        return [*self._data.qpos, *self._data.qvel, self._wanted_rad, self._integral_nm]

    def restore(self, state: list[float]) -> None:
        """Go on from :meth:`state`."""
        self._data.qpos[:], self._data.qvel[:] = state[:5], state[5:10]
        self._wanted_rad, self._integral_nm = state[10:]
        mujoco.mj_forward(self._model, self._data)


class Rigid:
    """The limit of a machine that gives way nowhere: the blade is where it should be, whatever acts on it."""

    def __init__(self, pose: Pose) -> None:
        self._pose, self._wrench = pose, Wrench()

    @property
    def pose(self) -> Pose:
        """See :class:`Holder`."""
        return self._pose

    def advance(self, wrench: Wrench, yaw_rad: float, duration_s: float) -> Pose:
        """See :class:`Holder`."""
        now, self._wrench = self._pose, wrench
        (x, y, z), (vx, vy, vz) = now.place_m, now.velocity_m_per_s
        place = (x + vx * duration_s, y + vy * duration_s, z + vz * duration_s)
        rate = (yaw_rad - now.yaw_rad) / duration_s
        self._pose = replace(now, place_m=place, yaw_rad=yaw_rad, yaw_rad_per_s=rate)
        return self._pose

    def readings(self) -> F64:
        """See :data:`READINGS`: the holders take all."""
        pose, wrench = self._pose, self._wrench
        (fx, fy, fz), nm = wrench.force_n, wrench.moment_nm[2]
        yaw = pose.yaw_rad
        lift = -fz / 2.0
        speed = pose.velocity_m_per_s[0]
        return np.array((*pose.place_m, 0.0, 0.0, yaw, yaw, speed, nm, -nm, lift, lift, 0.0, -fx, fy, 0.0))

    def state(self) -> list[float]:
        """All that goes on from one step to the next."""
        return [*self._pose.place_m, self._pose.yaw_rad, *self._pose.velocity_m_per_s, self._pose.yaw_rad_per_s]

    def restore(self, state: list[float]) -> None:
        """Go on from :meth:`state`."""
        x, y, z, yaw, vx, vy, vz, rate = state
        self._pose = Pose((x, y, z), yaw, (vx, vy, vz), rate)


def _friction(slip_m_per_s: float) -> float:
    """Table 1's coefficient at a slip, with its sign: smooth up to the static threshold."""
    share = min(1.0, abs(slip_m_per_s) / TABLE_1_STATIC_M_PER_S)
    return math.copysign(TABLE_1_FRICTION * share * share * (3.0 - 2.0 * share), slip_m_per_s)


def _mjcf(machine: Machine, pose: Pose) -> str:
    m, blade = machine, machine.blade
    x, y, z = pose.place_m
    half, thick = blade.length_m / 2.0, 0.02 * blade.length_m
    pivot = 1.2 * blade.height_m
    rod = (m.blade_kg * (blade.height_m**2 + thick**2) / 12.0, m.yaw_inertia_kg_m2)
    beam = m.drawbar_kg * m.lift_spacing_m**2 / 12.0
    mass = m.blade_kg + m.drawbar_kg
    heave_damping = 2.0 * m.damping_ratio * math.sqrt(2.0 * m.lift_n_per_m * mass) / 2.0
    pitch_nm = m.tilt_n_per_m * m.tilt_arm_m**2
    pitch_inertia = rod[0] + m.blade_kg * (pivot - blade.height_m / 2.0) ** 2
    pitch_damping = 2.0 * m.damping_ratio * math.sqrt(pitch_nm * pitch_inertia)
    # MuJoCo counts a contact's stiffness and damping for each kilogram that it moves: an end of the edge moves half.
    stiffness = TABLE_1_STIFFNESS_N_PER_M / (mass / 2.0)
    contact = f"{-stiffness} {-2.0 * math.sqrt(stiffness)}"
    ball = 0.01 * blade.length_m
    return f"""
<mujoco model="grader">
  <option timestep="{STEP_S}" gravity="0 0 {-NEWTON_G_M_PER_S2}" integrator="implicitfast"/>
  <compiler angle="radian" inertiafromgeom="false"/>
  <default><geom solref="{contact}" solimp="0.99 0.99 0.001" condim="1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="50 50 1" contype="1" conaffinity="2"/>
    <body name="chassis" pos="{x} {y} {z}">
      <inertial pos="0 0 {2 * pivot}" mass="{m.chassis_kg}" diaginertia="1 1 1"/>
      <joint name="travel" type="slide" axis="1 0 0"/>
      <body name="drawbar">
        <inertial pos="0 0 {pivot}" mass="{m.drawbar_kg}"
          diaginertia="{beam} {beam} {beam}"/>
        <joint name="heave" type="slide" axis="0 0 1"/>
        <joint name="roll" type="hinge" axis="1 0 0" pos="0 0 {pivot}"/>
        <site name="hitch" pos="0 0 {pivot}"/>
        <body name="circle">
          <inertial pos="0 0 {pivot}" mass="1e-3" diaginertia="1e-6 1e-6 1e-6"/>
          <joint name="yaw" type="hinge" axis="0 0 1" frictionloss="{m.servo_friction_nm}" limited="true"
            range="{-m.stops_rad} {m.stops_rad}"/>
          <body name="blade">
            <inertial pos="{-thick / 2} 0 {blade.height_m / 2}" mass="{m.blade_kg}"
              diaginertia="{rod[1]} {rod[0]} {rod[1]}"/>
            <joint name="pitch" type="hinge" axis="0 1 0" pos="0 0 {pivot}" stiffness="{pitch_nm}"
              damping="{pitch_damping}"/>
            <site name="foot"/>
            <geom type="sphere" size="{ball}" pos="0 {half} {ball}" contype="2" conaffinity="1"/>
            <geom type="sphere" size="{ball}" pos="0 {-half} {ball}" contype="2" conaffinity="1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="lift_left" stiffness="{m.lift_n_per_m}" damping="{heave_damping}">
      <joint joint="heave" coef="1"/><joint joint="roll" coef="{m.lift_spacing_m / 2}"/>
    </fixed>
    <fixed name="lift_right" stiffness="{m.lift_n_per_m}" damping="{heave_damping}">
      <joint joint="heave" coef="1"/><joint joint="roll" coef="{-m.lift_spacing_m / 2}"/>
    </fixed>
  </tendon>
  <actuator>
    <velocity name="drive" joint="travel" kv="{m.drive_n_s_per_m}"/>
    <motor name="servo" joint="yaw"/>
  </actuator>
  <sensor><force name="drawbar" site="hitch"/></sensor>
</mujoco>
"""
