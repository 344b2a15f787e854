"""Pose graphs with known truth, and gtsam's view of them."""

import gtsam
import jax.numpy as jnp
import jaxlie
import numpy as np

from lio_jax.pose_graph.graph import (
    LOOP,
    ODOMETRY,
    POSITION,
    PRIOR,
    PoseGraph,
    numbers_of,
    rotation_matrices,
    translations,
)


def walk(group, count, rng, step=1.0, turn=0.3):
    """Return (count,) poses of a random walk."""
    size = 6 if group is jaxlie.SE3 else 3
    twists = rng.normal(size=(count, size)) * turn
    twists[:, 0] += step
    poses = [group.identity()]
    for twist in twists[1:]:
        poses.append(poses[-1] @ group.exp(jnp.asarray(twist)))
    return stacked(poses)


def stacked(poses):
    return type(poses[0])(jnp.stack([pose.parameters() for pose in poses]))


def at(poses, index):
    return type(poses)(jnp.asarray(numbers_of(poses)[index]))


def random_information(count, size, rng, scale=1e3):
    """Return full matrices, far from diagonal."""
    root = rng.normal(size=(count, size, size))
    return scale * (root @ root.transpose(0, 2, 1) + 0.3 * np.eye(size))


def measured(truth, pairs, information, rng, noise=1.0):
    """Return relative poses with errors of the given information, scaled by ``noise``."""
    size = information.shape[-1]
    spread = np.linalg.cholesky(np.linalg.inv(information))
    errors = noise * np.einsum("eij,ej->ei", spread, rng.normal(size=(len(pairs), size)))
    errors = np.roll(errors, -3 if size == 6 else -1, axis=-1)
    exact = at(truth, pairs[:, 0]).inverse() @ at(truth, pairs[:, 1])
    return exact @ type(truth).exp(jnp.asarray(errors))


def graph_of(truth, loops, rng, noise=1.0, scale=1e3, information=None):
    """Return a chain with loops, its poses those of its odometry, and its first vertex fixed."""
    count = len(numbers_of(truth))
    chain = np.stack([np.arange(count - 1), np.arange(1, count)], -1)
    pairs = np.concatenate([chain, np.asarray(loops, int).reshape(-1, 2)])
    size = truth.tangent_dim
    if information is None:
        information = random_information(len(pairs), size, rng, scale)
    measurement = measured(truth, pairs, information, rng, noise)
    poses = [at(truth, 0)]
    for k in range(count - 1):
        poses.append(poses[-1] @ at(measurement, k))
    return PoseGraph(
        stacked(poses),
        jnp.asarray(pairs[:, 0]),
        jnp.asarray(pairs[:, 1]),
        measurement,
        jnp.asarray(information),
        jnp.asarray([ODOMETRY] * (count - 1) + [LOOP] * (len(pairs) - count + 1)),
        jnp.asarray(np.arange(count) == 0),
    )


def with_edges(graph, i, j, measurement, information, kind, lever=None):
    """Return the graph with further edges, their levers where one is given."""
    if lever is None:
        levers = graph.lever
    else:
        none = np.zeros((len(graph.i), np.shape(lever)[-1]))
        levers = jnp.concatenate([none if graph.lever is None else graph.lever, jnp.asarray(lever)])
    numbers = np.concatenate([numbers_of(graph.measurement), numbers_of(measurement)])
    return PoseGraph(
        graph.poses,
        jnp.concatenate([graph.i, jnp.asarray(i)]),
        jnp.concatenate([graph.j, jnp.asarray(j)]),
        type(measurement)(jnp.asarray(numbers)),
        jnp.concatenate([graph.information, jnp.asarray(information)]),
        jnp.concatenate([graph.kind, jnp.full(len(i), kind)]),
        graph.fixed,
        levers,
    )


def with_priors_and_positions(graph, rng, priors=(4, 19), positions=(7, 11, 25), lever=()):
    """Return the graph tied to the world by measurements instead of a fixed vertex."""
    size = graph.information.shape[-1]
    truth = graph.poses
    if priors:
        poses = measured(
            truth, np.zeros((len(priors), 2), int), random_information(len(priors), size, rng), rng
        )
        poses = at(truth, list(priors)) @ poses
        graph = with_edges(graph, priors, priors, poses, random_information(len(priors), size, rng), PRIOR)
    if positions:
        information = random_information(len(positions), size, rng)
        turning = 3 if size == 6 else 1
        information[:, :turning] = information[:, :, :turning] = 0
        own = at(truth, list(positions))
        levers = np.tile(lever, (len(positions), 1)) if len(lever) else None
        shifts = numbers_of(own).copy()
        if levers is not None:
            shifts[:, turning - size :] += np.einsum("eij,ej->ei", rotation_matrices(own), levers)
        shifts[:, turning - size :] += 0.05 * rng.normal(size=(len(positions), size - turning))
        fixes = type(truth)(jnp.asarray(shifts))
        graph = with_edges(graph, positions, positions, fixes, information, POSITION, levers)
    return with_poses(graph, graph.poses, np.zeros(len(graph.fixed), bool))


def with_poses(graph, poses, fixed=None):
    fixed = graph.fixed if fixed is None else jnp.asarray(fixed)
    return PoseGraph(
        poses, graph.i, graph.j, graph.measurement, graph.information, graph.kind, fixed, graph.lever
    )


def gtsam_pose(rotation, translation):
    if len(translation) == 3:
        return gtsam.Pose3(gtsam.Rot3(rotation), translation)
    return gtsam.Pose2(*translation, np.arctan2(rotation[1, 0], rotation[0, 0]))


def gtsam_values(poses):
    values = gtsam.Values()
    for number, (R, t) in enumerate(zip(rotation_matrices(poses), translations(poses), strict=True)):
        values.insert(number, gtsam_pose(R, t))
    return values


def gtsam_graph(graph):
    """Return gtsam's graph: our order of tangents is that of its Pose3; its Pose2 has the angle last."""
    space = graph.information.shape[-1] == 6
    between = gtsam.BetweenFactorPose3 if space else gtsam.BetweenFactorPose2
    prior = gtsam.PriorFactorPose3 if space else gtsam.PriorFactorPose2
    equal = gtsam.NonlinearEqualityPose3 if space else gtsam.NonlinearEqualityPose2
    information = np.asarray(graph.information)
    if not space:
        information = np.roll(information, -1, axis=(1, 2))
    R, t = rotation_matrices(graph.measurement), translations(graph.measurement)
    factors = gtsam.NonlinearFactorGraph()
    for k, (i, j, kind) in enumerate(
        zip(graph.i.tolist(), graph.j.tolist(), graph.kind.tolist(), strict=True)
    ):
        if kind == POSITION:
            weight = information[k][3:, 3:] if space else information[k][:2, :2]
            lever = np.zeros(len(t[k])) if graph.lever is None else np.asarray(graph.lever)[k]
            factors.add(gtsam_position(j, t[k], lever, gtsam.noiseModel.Gaussian.Information(weight)))
            continue
        noise = gtsam.noiseModel.Gaussian.Information(information[k])
        pose = gtsam_pose(R[k], t[k])
        factors.add(prior(j, pose, noise) if kind == PRIOR else between(i, j, pose, noise))
    R, t = rotation_matrices(graph.poses), translations(graph.poses)
    for number in np.flatnonzero(np.asarray(graph.fixed)).tolist():
        factors.add(equal(number, gtsam_pose(R[number], t[number])))
    return factors


def gtsam_position(j, fix, lever, noise):
    """Return gtsam's factor of a GPS antenna; in the plane, where it has none, one made for it."""
    if len(fix) == 3:
        return gtsam.GPSFactorArm(j, fix, lever, noise)

    def error(factor, values, jacobians):
        pose = values.atPose2(j)
        if jacobians is not None:
            across = np.array([[-lever[1]], [lever[0]]])
            jacobians[0] = pose.rotation().matrix() @ np.hstack([np.eye(2), across])
        return pose.transformFrom(lever) - fix

    return gtsam.CustomFactor(noise, [j], error)


def gtsam_optimum(factors, values):
    """Return gtsam's optimum from these values, to the last digit."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(300)
    params.setRelativeErrorTol(1e-14)
    params.setAbsoluteErrorTol(1e-14)
    return gtsam.LevenbergMarquardtOptimizer(factors, values, params).optimize()
