"""Answers beyond success rates: causes of a failure, decisive moments, regions where a policy fails."""
