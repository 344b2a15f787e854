"""The chain of states and measurements of a recording as a factor graph of gtsam."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from simulated_chain import IMU, Recording

from lio_jax.estimation.factors import FLOOR
from lio_jax.estimation.motion_state import MotionState
from lio_jax.imu.params import ImuParams

ORDER = [*range(9), 12, 13, 14, 9, 10, 11]
"""Order of gtsam's state: the accelerometer's bias comes before the gyroscope's."""


class GtsamChain:
    """A recording's states and factors, one at a time or all at once."""

    def __init__(self, recording: Recording, params: ImuParams = IMU) -> None:
        """Preintegrate all links."""
        self.chain, self.size = recording.chain, len(recording.guess.velocity)
        self.guess = _numpy(recording.guess)
        self.bag = gtsam.PreintegrationCombinedParams.MakeSharedU(-float(recording.chain.gravity[2]))
        self.bag.setImuFactorErrorMode(gtsam.ImuFactorErrorMode.ComponentWise)
        self.bag.setIntegrationCovariance(np.zeros((3, 3)))
        for name, density in (
            ("Gyroscope", params.gyro_noise),
            ("Accelerometer", params.accel_noise),
            ("BiasOmega", params.gyro_bias_walk),
            ("BiasAcc", params.accel_bias_walk),
        ):
            getattr(self.bag, f"set{name}Covariance")(np.eye(3) * float(density) ** 2)
        i, imu = recording.intervals, recording.chain.imu
        samples = [np.asarray(x) for x in (i.accel, i.gyro, i.duration)]
        self.links = [self._preintegrated(*rows) for rows in zip(imu.accel_bias, imu.gyro_bias, *samples)]  # noqa: B905
        floored = np.asarray(imu.covariance) + np.diag(np.square(FLOOR))
        self.covariance = floored[:, ORDER][:, :, ORDER]
        self.poses = np.asarray(recording.chain.lidar.T_world_imu.as_matrix())
        self.information = np.asarray(recording.chain.lidar.information)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return all factors."""
        graph = gtsam.NonlinearFactorGraph()
        for k in range(self.size):
            for factor in self.factors(k):
                graph.add(factor)
        return graph

    def values(self) -> gtsam.Values:
        """Return the guess of all states."""
        values = gtsam.Values()
        for k in range(self.size):
            self.insert(values, k)
        return values

    def insert(self, values: gtsam.Values, k: int) -> None:
        """Insert the guess of one state."""
        pose, velocity, gyro_bias, accel_bias = (rows[k] for rows in self.guess)
        values.insert(X(k), gtsam.Pose3(pose))
        values.insert(V(k), velocity)
        values.insert(B(k), gtsam.imuBias.ConstantBias(accel_bias, gyro_bias))

    def factors(self, k: int) -> list[gtsam.NonlinearFactor]:
        """Return the factors that state ``k`` adds: its own measurements and the link that leads to it."""
        chain, noise = self.chain, gtsam.noiseModel.Gaussian
        model = noise.Information(self.information[k])
        found = [gtsam.PriorFactorPose3(X(k), gtsam.Pose3(self.poses[k]), model)]
        if k == 0:
            found += self._prior()
        else:
            keys = (X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k))
            link = gtsam.GalileanCombinedImuFactor(*keys, self.links[k - 1])
            # ours, because gtsam has the opposite sign of the correlation between drift and motion
            found.append(link.cloneWithNewNoiseModel(noise.Covariance(self.covariance[k - 1])))
        relative, gps = chain.relative, chain.gps
        if relative is not None and k > 0:
            between = gtsam.Pose3(np.asarray(relative.T_imu_next.as_matrix()[k - 1]))
            model = noise.Information(np.asarray(relative.information[k - 1]))
            found.append(gtsam.BetweenFactorPose3(X(k - 1), X(k), between, model))
        if gps is not None and gps.mask[k]:
            model = gtsam.noiseModel.Diagonal.Sigmas(np.asarray(gps.sigma[k]))
            arm = np.asarray(gps.lever_arm[k])
            found.append(gtsam.GPSFactorArm(X(k), np.asarray(gps.position[k]), arm, model))
        return found

    def _prior(self) -> list[gtsam.NonlinearFactor]:
        prior = self.chain.prior
        sigma = np.diag(np.asarray(prior.information)) ** -0.5
        model = gtsam.noiseModel.Diagonal.Sigmas
        bias = gtsam.imuBias.ConstantBias(
            np.asarray(prior.origin.accel_bias), np.asarray(prior.origin.gyro_bias)
        )
        pose = gtsam.Pose3(np.asarray(prior.origin.T_world_imu.as_matrix()))

        def error(factor: gtsam.CustomFactor, values: gtsam.Values, H: list[np.ndarray]) -> np.ndarray:
            # rotation and position separately; PriorFactorPose3 takes the logarithm of the whole pose
            missed = pose.between(values.atPose3(X(0)))
            turn = gtsam.Rot3.Logmap(missed.rotation())
            if H is not None:
                H[0] = np.zeros((6, 6), order="F")
                H[0][:3, :3] = gtsam.Rot3.LogmapDerivative(turn)
                H[0][3:, 3:] = missed.rotation().matrix()
            return np.concatenate([turn, missed.translation()])

        return [
            gtsam.CustomFactor(model(sigma[:6]), [X(0)], error),
            gtsam.PriorFactorVector(V(0), np.asarray(prior.origin.velocity), model(sigma[6:9])),
            gtsam.PriorFactorConstantBias(B(0), bias, model(np.concatenate([sigma[12:], sigma[9:12]]))),
        ]

    def _preintegrated(self, accel_bias, gyro_bias, accel, gyro, duration):
        bias = gtsam.imuBias.ConstantBias(np.asarray(accel_bias), np.asarray(gyro_bias))
        link = gtsam.PreintegratedCombinedMeasurementsG(self.bag, bias)
        for a, w, h in zip(accel, gyro, duration, strict=True):
            link.integrateMeasurement(a, w, float(h))
        return link


def states_of(values: gtsam.Values, numbers: range) -> list[np.ndarray]:
    """Return poses (4x4), velocities, gyro and accelerometer biases."""
    biases = [values.atConstantBias(B(k)) for k in numbers]
    return [
        np.stack([values.atPose3(X(k)).matrix() for k in numbers]),
        np.stack([values.atVector(V(k)) for k in numbers]),
        np.stack([bias.gyroscope() for bias in biases]),
        np.stack([bias.accelerometer() for bias in biases]),
    ]


def covariance_of(marginals: gtsam.Marginals, pose: gtsam.Pose3, k: int) -> np.ndarray:
    """Return the covariance of a state's error in our order; gtsam perturbs the velocity in world axes."""
    keys = (X(k), V(k), B(k))
    joint = marginals.jointMarginalCovariance(gtsam.KeyVector(keys))
    matrix = np.block([[joint.at(row, column) for column in keys] for row in keys])
    turn = np.eye(15)
    turn[6:9, 6:9] = pose.rotation().matrix().T
    return (turn @ matrix @ turn.T)[np.ix_(ORDER, ORDER)]


def _numpy(states: MotionState) -> list[np.ndarray]:
    parts = (states.T_world_imu.as_matrix(), states.velocity, states.gyro_bias, states.accel_bias)
    return [np.asarray(part) for part in parts]
