"""Time of one compiled tick with everything on: contact, force at every tick, poses and estimates at 40 Hz."""

from __future__ import annotations

import numpy as np
from numba import njit

from host.studies.control.runs import REGULAR
from protocol.enums import Phase
from protocol.rig_file import Rig
from realtime.control import inverse_kinematics
from realtime.control.configure import tick_parameters
from realtime.control.tick import tick
from realtime.loop.libc import monotonic_ns
from sim.ideal_rig import IdealRig
from sim.plant import PlantConfig
from sim.scenario import TARGET_M
from sim.vessel import VesselConfig

TICKS = 20_000
WARM_UP_S = 8.0


@njit(cache=True)
def _timed(params, state, inputs, outputs, noise_N, period_ns: int, out_us) -> None:  # type: ignore[no-untyped-def]
    u, every = inputs[0], max(25_000_000 // period_ns, 1)
    for k in range(len(out_us)):
        u.now_ns += period_ns
        u.board.arrival_ns = u.now_ns
        u.sensor.count += 1
        u.sensor.stamp_ns, u.sensor.arrival_ns = u.now_ns - 100_000, u.now_ns
        u.sensor.force_N[2] = 0.2 + noise_N[k]
        if k % every == 0:
            u.tip.count += 1
            u.tip.stamp_ns, u.tip.arrival_ns = u.now_ns - 25_000_000, u.now_ns
        if k % every == every // 5:
            u.estimate.count += 1
            u.estimate.stamp_ns, u.estimate.arrival_ns = u.now_ns - 30_000_000, u.now_ns
            u.estimate.force_N[2] = u.estimate.nominal_N[2] = 0.2 + 3.0 * noise_N[k]
            for i in range(3):
                u.estimate.covariance_N2[i, i] = u.estimate.nominal_covariance_N2[i, i] = 4e-4
        begin_ns = monotonic_ns()
        tick(params, state, inputs, outputs)
        out_us[k] = (monotonic_ns() - begin_ns) * 1e-3


def tick_us(rig: Rig, seed: int = 1) -> dict[str, float]:
    """Percentiles of the tick's time (us) over TICKS ticks in contact, on the machine as it is; best of three rounds."""
    out = np.zeros(3)
    kinematics = tick_parameters(rig)[0].kinematics
    out[:] = inverse_kinematics.apply(kinematics, np.array(TARGET_M) - (0.0, 0.0, 0.003), 0.0)
    handle = out[0] - rig.transmission.insertion_at_home_m + 0.5 * rig.transmission.insertion_backlash_m
    bench = IdealRig(
        rig,
        PlantConfig(start_stage=(float(handle), 0.0, float(out[2])), heart=REGULAR, vessel=VesselConfig(start_in_play=1.0)),
        seed,
    )
    bench.press(0.2, np.array(TARGET_M), WARM_UP_S)
    if bench.outputs[0].phase != Phase.CONTACT:
        raise ValueError("control study: found no contact, wanted it before the tick is timed")
    noise_N = rig.force_sensor.noise_N * np.random.default_rng(seed).standard_normal(TICKS)
    records = (bench.params, bench.state, bench.inputs, bench.outputs)
    period_ns, rounds = round(1e9 / rig.control.loop_hz), []
    _timed(*records, noise_N, period_ns, np.zeros(100))
    for _ in range(3):
        times_us = np.zeros(TICKS)
        _timed(*records, noise_N, period_ns, times_us)
        rounds.append(np.percentile(times_us, (50, 99, 99.9)))
    if bench.outputs[0].phase != Phase.CONTACT:
        raise ValueError("control study: found the contact lost, wanted it for as long as the tick is timed")
    p50, p99, p999 = np.min(rounds, axis=0)
    return {"p50": float(p50), "p99": float(p99), "p999": float(p999), "ticks": float(TICKS)}
