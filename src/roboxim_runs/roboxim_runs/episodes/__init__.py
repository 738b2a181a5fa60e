"""Runs of episodes: demonstrations, and recorded episodes rendered or executed again."""
