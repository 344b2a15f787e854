"""Pick LOAM's features of one scan."""

from functools import partial

import jax

from lio_jax import SimulatedSequence, imu_feed, loam_features, recipe_settings, scan_inputs, settings_for

recording = SimulatedSequence("street", duration_s=0.1, beams=16, columns=512)
settings, _ = settings_for(recording, recipe_settings("loam"))
scan = next(scan_inputs(settings, recording.scans(), imu_feed(recording, settings)[0])).scan

features = jax.jit(partial(loam_features, settings.config))(settings.params(), scan)
for name in ("sharp", "less_sharp", "flat", "less_flat"):
    cloud = getattr(features, name)
    print(f"{name}: {int(cloud.mask.sum())} points in a padded array of {cloud.points.shape}")
