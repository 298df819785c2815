"""The joint stage: geometry, material and light by path tracing."""
