"""Pictures of runs: read run folders, know nothing of the learner."""
