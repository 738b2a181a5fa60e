"""Tasks of several steps: a sequence is a skill that is made of others, and a task of one skill has one step."""
