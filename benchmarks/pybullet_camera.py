"""Times a `BulletCamera`'s call beside PyBullet's `getCameraImage` of the same picture.

    python benchmarks/pybullet_camera.py [--sizes 84 240] [--rounds 30]

The two take turns. Times are medians of CPU times, so that other work on the machine does not
count.
"""

import argparse
import statistics
import time

import pybullet
import pybullet_data

from flowrep.pybullet import BulletCamera

ROBOTS = ("kuka_iiwa/model.urdf", "a1/a1.urdf", "franka_panda/panda.urdf")


def cpu_ms(call) -> float:
    start = time.process_time()
    call()
    return 1e3 * (time.process_time() - start)


def compare(robot: str, size: int, rounds: int) -> str:
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setAdditionalSearchPath(pybullet_data.getDataPath(), client)
    for body in ("plane.urdf", robot):
        number = pybullet.loadURDF(body, physicsClientId=client)
    links = pybullet.getNumJoints(number, client)
    view = pybullet.computeViewMatrix([1.5, -1.0, 1.0], [0, 0, 0.4], [0, 0, 1])
    projection = pybullet.computeProjectionMatrixFOV(60, 1.0, 0.05, 100)
    renderer = pybullet.ER_TINY_RENDERER

    def bare() -> None:
        pybullet.getCameraImage(
            size, size, view, projection, shadow=0, renderer=renderer, physicsClientId=client
        )

    camera = BulletCamera(client, size, size, projection=projection, view=view, renderer=renderer)
    camera.reset()
    times = [(cpu_ms(bare), cpu_ms(camera)) for _ in range(rounds)]
    pybullet.disconnect(client)
    one, other = (statistics.median(column) for column in zip(*times))
    what = f"{robot:24} {links:3} links {size:4} px"
    return f"{what}: {one:6.2f} ms, {other:6.2f} ms, × {other / one:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[84, 240])
    parser.add_argument("--rounds", type=int, default=30)
    args = parser.parse_args()
    print("getCameraImage, BulletCamera, ratio")
    for robot in ROBOTS:
        for size in args.sizes:
            print(compare(robot, size, args.rounds))


if __name__ == "__main__":
    main()
