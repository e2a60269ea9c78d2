"""The harness: the simulator held against independent engines and against the laws of mechanics."""
