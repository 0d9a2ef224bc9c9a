"""Parts of ns-normlift-batch: capture list, shards, workers, processes and results."""
