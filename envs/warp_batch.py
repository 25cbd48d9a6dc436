"""Many simulations of one model on mujoco-warp, with the interface of `mujoco.batch`.

In single precision, on a GPU or on Warp's CPU device. `bind` gives torch tensors that share the
simulations' memory: who computes on them stays on the device. Needs the extra `gpu`.
"""

import os
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from goalgan_bt.envs.goal_env import Ids, PhysicsError
from goalgan_bt.envs.maze import FloatArray

# Per simulation. Ants that were thrown into corners at full force needed 15 and 63 at most.
MAX_CONTACTS, MAX_CONSTRAINTS = 24, 128


class WarpBatch:
    """N simulations of a model.

    mujoco-warp steps all simulations of a batch, also those that `step` is told to leave alone:
    these get their state back afterwards, at the cost of having been simulated.

    Args:
        model: the compiled model.
        num_envs: N.
        device: `cpu`, `cuda`, `cuda:1`, ...; `auto` is a GPU where there is one.

    Attributes:
        device: as Warp names it, for example `cuda:0`.
        rows: the states on the host: `rows[ids]` copies qpos and qvel of some simulations,
            (n, nq + nv) float64, and `rows[ids] = states` writes them.

    Raises:
        PhysicsError: without the extra `gpu`, without the device, or for a model that needs what
            mujoco-warp does not have.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: str = "auto") -> None:
        self._warp, self._mjw = _import()
        self.num_envs = num_envs
        try:
            self._device = self._warp.get_device(self._best() if device == "auto" else device)
        except (ValueError, RuntimeError):
            known = ", ".join(str(d) for d in self._warp.get_devices())
            raise PhysicsError(f"Warp has no device {device!r} here: choose of {known}") from None
        self.device = str(self._device)
        with self._warp.ScopedDevice(self._device):
            try:
                self._model = self._mjw.put_model(model)
            except NotImplementedError as error:
                raise PhysicsError(f"mujoco-warp cannot run this model: {error}") from None
            self._data = self._mjw.make_data(
                model, nworld=num_envs, nconmax=MAX_CONTACTS, njmax=MAX_CONSTRAINTS
            )
        self._warp.synchronize_device(self._device)
        # All that one step hands to the next.
        self._carried = [self.bind(name) for name in ("time", "qpos", "qvel", "qacc_warmstart")]
        self._ctrl = self.bind("ctrl")
        self._graph: Any = None
        self.rows = _Rows(self.bind("qpos"), self.bind("qvel"))

    def _best(self) -> str:
        """A GPU if there is one, of several another for each of torchrun's processes here."""
        count = self._warp.get_cuda_device_count()
        return f"cuda:{int(os.environ.get('LOCAL_RANK', '0')) % count}" if count else "cpu"

    @property
    def state(self) -> "_Carried":
        """All that one step hands to the next, (N, k) float32: `np.array(state)` copies it,
        `state[:] = rows` writes it."""
        return _Carried([*self._carried, self._ctrl])

    def bind(self, name: str) -> Tensor:
        """A field of mujoco-warp's data, (N, ...), as a tensor that shares its memory."""
        return self._warp.to_torch(getattr(self._data, name), requires_grad=False)

    def reset(self, ids: Ids, stage: int = 0) -> None:
        """Clear time, speed, controls and the solver's warm start of some simulations.

        Args:
            ids: (n,).
            stage: up to which derived fields are computed: 0, none.
        """
        time, _, qvel, warm_start = self._carried
        for field in (time, qvel, warm_start, self._ctrl):
            field[ids] = 0.0

    def step(self, ids: Ids | None = None, nstep: int = 1) -> None:
        """Take `nstep` steps in some simulations, (n,) sorted indices, or in all."""
        if ids is not None and len(ids) < self.num_envs:
            idle = np.setdiff1d(np.arange(self.num_envs), ids)
            kept = [field[idle] for field in self._carried]
            self._advance(nstep)
            for field, values in zip(self._carried, kept, strict=True):
                field[idle] = values
        else:
            self._advance(nstep)

    def _advance(self, nstep: int) -> None:
        if not self._device.is_cuda:
            with self._warp.ScopedDevice(self._device):
                for _ in range(nstep):
                    self._mjw.step(self._model, self._data)
            return
        # On torch's stream: what torch wrote before is there, what it reads next has been done.
        stream = self._warp.stream_from_torch(torch.cuda.current_stream(self._device.ordinal))
        if self._graph is None:
            self._graph = self._record()
        for _ in range(nstep):
            self._warp.capture_launch(self._graph, stream=stream)

    def _record(self) -> Any:
        """One step as a CUDA graph: its hundred kernels are then launched as one."""
        kept = [field.clone() for field in self._carried]
        torch.cuda.synchronize(self._device.ordinal)  # Warp records on a stream of its own
        with self._warp.ScopedDevice(self._device):
            self._mjw.step(self._model, self._data)  # compiles: not possible while recording
            with self._warp.ScopedCapture() as capture:
                self._mjw.step(self._model, self._data)
            self._warp.synchronize_device()
        for field, values in zip(self._carried, kept, strict=True):
            field.copy_(values)
        return capture.graph


class _Rows:
    """The states of a batch as rows on the host (see `WarpBatch`)."""

    def __init__(self, qpos: Tensor, qvel: Tensor) -> None:
        self._qpos, self._qvel = qpos, qvel

    def __getitem__(self, ids: Ids) -> FloatArray:
        parts = [field[ids].cpu().numpy() for field in (self._qpos, self._qvel)]
        return np.concatenate(parts, axis=1, dtype=np.float64)

    def __setitem__(self, ids: Ids, states: NDArray[np.floating]) -> None:
        rows = torch.as_tensor(np.array(states, dtype=np.float32), device=self._qpos.device)
        self._qpos[ids] = rows[:, : self._qpos.shape[1]]
        self._qvel[ids] = rows[:, self._qpos.shape[1] :]


class _Carried:
    """Fields of a batch as rows on the host (see `WarpBatch.state`)."""

    def __init__(self, fields: list[Tensor]) -> None:
        self._fields = fields

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[np.float32]:
        return np.concatenate([f.reshape(len(f), -1).cpu().numpy() for f in self._fields], axis=1)

    def __setitem__(self, _: slice, rows: NDArray[np.floating]) -> None:
        sizes = [field[0].numel() for field in self._fields]
        for field, part in zip(self._fields, torch.from_numpy(rows).split(sizes, 1), strict=True):
            field.copy_(part.reshape(field.shape))


def _import() -> tuple[Any, Any]:
    """Warp and mujoco-warp.

    Raises:
        PhysicsError: if they are not installed.
    """
    try:
        import array_api_compat.torch  # noqa: F401
        import warp

        # Kernels are compiled at their first use, which is no news to anybody.
        warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)
        import mujoco_warp

        import goalgan_bt.envs.steep_capsules  # noqa: F401
    except ImportError as error:
        raise PhysicsError(
            f"physics 'warp' needs {error.name}: install the extra `gpu`, "
            'for example with pip install -e ".[gpu]"'
        ) from None
    return warp, mujoco_warp
