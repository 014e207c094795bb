"""Surface EMG: envelopes, reflex responses, relaxation and co-contraction."""
