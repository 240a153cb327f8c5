"""Every test runs with the shapes in our signatures checked, and with no silent broadcasting between ranks."""

import jax
import jaxtyping

jax.config.update("jax_numpy_rank_promotion", "raise")
jaxtyping.install_import_hook("beliefrl", "beartype.beartype")  # before the first import of beliefrl
