"""Every test computes in 64 bits."""

import jax

jax.config.update("jax_enable_x64", True)
# Large batches were seen to wait for ever when the processor is dispatched to asynchronously (jaxlib 0.10).
jax.config.update("jax_cpu_enable_async_dispatch", False)
