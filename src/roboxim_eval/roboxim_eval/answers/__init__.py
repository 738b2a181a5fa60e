"""Answers that no success rate gives: causes of a failure, decisive moments, regions where a policy fails."""
