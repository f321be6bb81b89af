"""The algorithms of the cluster refiners; `plugins.refiners` are their parameters."""
