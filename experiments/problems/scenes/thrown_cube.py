"""A cube that is thrown at or over a wall, simulated by MuJoCo: from the launch to where the cube comes to rest.

The cube has sides of 20 cm and starts at x = y = 0, 50 cm above the floor. The wall stands at x = 2 m, 1 m high. Where
the cube comes to rest jumps with the launch: the cube bounces off the wall, tumbles over its top or flies past.

On the hard floor the cube tumbles on. There its end is no smooth function of the launch: a change of 0.05 `UNITS` moves
it by half a metre. In sand the cube stays about where it falls, and the same change moves its end by 5 cm.
"""

import os
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

SECONDS = 2.0
"""Simulated time; most cubes lie still after it."""
_STEP = 0.01
_PARTS = 10
"""Parts of the simulated time, after each of which it is seen whether the cube lies still."""
_STILL = 1e-3
"""Velocity [m/s] and spin [rad/s] of a cube that lies still."""
Ground = Literal["floor", "sand"]
_GROUNDS: dict[Ground, str] = {
    "floor": 'friction=".6 .01 .001"',
    # Five steps of time to stop in, not two: where a contact falls between two steps then hardly matters.
    "sand": 'friction="2 .1 .1" condim="6" solref=".05 1" priority="1"',
}
"""Contact of the cube with the ground. The wall is hard on both."""
_SCENE = f"""
<mujoco>
  <option timestep="{_STEP}" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="20 20 .1" %s/>
    <geom type="box" pos="2 0 .5" size=".05 3 .5"/>
    <body pos="0 0 .5">
      <freejoint/>
      <geom type="box" size=".1 .1 .1" mass="1" friction=".6 .01 .001"/>
    </body>
  </worldbody>
</mujoco>
"""
UNITS = (0.5, 0.5, 0.5, 5.0, 5.0)
"""Velocity along x, y and z [m/s], and spin about x and y [rad/s], that move the end of a throw by a similar length."""
LOWER, UPPER = (2.0, -3.0, 0.0, -2.0, -2.0), (10.0, 3.0, 12.0, 2.0, 2.0)
"""Launches, in `UNITS`: velocities of 1 to 5, -1.5 to 1.5 and 0 to 6 m/s, spins of -10 to 10 rad/s."""


class ThrownCube:
    """Launches [K, 5] in `UNITS` to the places where the cube ends, x and y in metres, [K, 2].

    A pickled simulation leaves the state of MuJoCo behind.
    """

    n = len(UNITS)

    def __init__(self, ground: Ground = "floor") -> None:
        self.ground: Ground = ground

    def __reduce__(self) -> tuple[type["ThrownCube"], tuple[Ground]]:
        return type(self), (self.ground,)

    @cached_property
    def _simulation(self) -> tuple[Any, Any, Any]:
        os.environ.setdefault("MUJOCO_GL", "disabled")  # no picture is drawn
        import mujoco

        model = mujoco.MjModel.from_xml_string(_SCENE % _GROUNDS[self.ground])
        return mujoco, model, mujoco.MjData(model)

    def __call__(self, x: Tensor) -> Tensor:
        mujoco, model, data = self._simulation
        launches = (x.detach().double() * torch.tensor(UNITS, dtype=torch.float64)).numpy()
        ends = np.empty((len(launches), 2))
        for end, launch in zip(ends, launches, strict=True):
            mujoco.mj_resetData(model, data)
            data.qvel[:5] = launch
            for _ in range(_PARTS):
                mujoco.mj_step(model, data, nstep=round(SECONDS / _STEP / _PARTS))
                if abs(data.qvel).max() < _STILL:
                    break
            end[:] = data.qpos[:2]
        return torch.from_numpy(ends)
