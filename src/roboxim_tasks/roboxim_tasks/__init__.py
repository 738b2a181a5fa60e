"""Tasks, instructions, scene resets, the scripted expert, judging, and the task node."""
