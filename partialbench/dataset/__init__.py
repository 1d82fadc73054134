"""Categories, the shard format, building, loading and verifying data sets."""
