"""Sessions around the model's step: feeding of captures and live views, scene deltas, shards."""
