"""Everything that compares: benchmarks, ablations, stability sweeps, both ways of a plan, and the report of it all."""
