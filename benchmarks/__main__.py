"""Runs every benchmark."""

from benchmarks import batch_overhead, multisine_crest

for module in (batch_overhead, multisine_crest):
    print(f"== {module.__name__}")
    module.main()
