"""Where a node keeps its data: in memory (`memory`) or on disk (`sqlite`).

Both implement `rass_mav.core.store.Store`. `reader` reads a store on disk from outside, also while its node runs.
"""
