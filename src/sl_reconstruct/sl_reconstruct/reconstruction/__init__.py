"""From a stack to a cloud: decoding and triangulation put together, and what may be trusted."""
