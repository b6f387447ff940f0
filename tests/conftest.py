"""For all tests: compiled programs are kept between runs, and random examples are the same in every run."""

import os

import hypothesis
import jax

hypothesis.settings.register_profile("tlq", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("tlq")


def pytest_configure(config):
    # Most of the tests' time is compilation. A folder that was chosen outside (CI) stays.
    cache = getattr(config, "cache", None)
    if cache is not None and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(cache.mkdir("jax")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
