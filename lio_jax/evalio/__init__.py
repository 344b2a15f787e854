"""The recipes as pipelines of evalio, a harness of LiDAR-inertial systems, and the simulated worlds as its
datasets.

evalio finds them where the environment says ``EVALIO_CUSTOM=lio_jax.evalio``, or once this module is
imported.
"""

import sys
import warnings
from contextlib import suppress

try:
    from evalio import datasets as _datasets
    from evalio import pipelines as _pipelines
except ImportError as error:
    raise ImportError(
        "lio_jax.evalio needs evalio, which is not installed; install it with pip install 'lio-jax[bench]'."
    ) from error

with warnings.catch_warnings():
    # evalio asks rerun for its old module "datatypes", and rerun from 0.37 on then asks itself without end.
    # Once the module is loaded, nothing is asked; it warns of its age.
    warnings.simplefilter("ignore", DeprecationWarning)
    with suppress(ImportError):
        import rerun.datatypes  # noqa: F401

from lio_jax.evalio.datasets import WORLD_DATASETS
from lio_jax.evalio.pipelines import LioJaxDefault, LioJaxFastLio2, LioJaxLioSam, LioJaxLoam

__all__ = ["WORLD_DATASETS", "LioJaxDefault", "LioJaxFastLio2", "LioJaxLioSam", "LioJaxLoam"]

# evalio registers what it finds among a module's names
globals().update({dataset.__name__: dataset for dataset in WORLD_DATASETS.values()})
# where this module is imported before evalio, evalio looks for them too early
_pipelines.register_pipeline(module=sys.modules[__name__])
_datasets.register_dataset(module=sys.modules[__name__])
