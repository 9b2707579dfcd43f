"""A unit to try the driver on: sends lines ten times as fast as a real one."""

import asyncio

import numpy as np

from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import SyntheticUnit, Tumble

SPEED, RATE_HZ = 10, 100
SENSOR = Sensor(np.array([9.81, 9.79, 9.83]), np.array([3e-3, -2e-3, 1e-3]), np.array([0.01, -0.02, 0.005]))


async def send(_reader, writer):
    path = Tumble(np.array([up for _, up in directions(14)]), hold_s=4.0, move_s=1.5)
    unit = SyntheticUnit(SENSOR, path, np.full(3, 2e-4))
    for block in range(10_000):
        counter = np.arange(block * 10, block * 10 + 10)
        readings, _ = unit.sample(counter / RATE_HZ)
        for n, (x, y, z) in zip(counter.tolist(), readings.tolist(), strict=True):
            writer.write(f"{n},{x:.6f},{y:.6f},{z:.6f}\n".encode())
        try:
            await writer.drain()
        except ConnectionError:
            return
        await asyncio.sleep(10 / RATE_HZ / SPEED)


async def main():
    async with await asyncio.start_server(send, "127.0.0.1", 15030) as server:
        await server.serve_forever()


asyncio.run(main())
