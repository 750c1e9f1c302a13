"""Many pictures: one after the other, in processes or on a cluster, each a line of results.jsonl."""
