"""One description of each robot and each object: sim realises it, planner collides with it, tasks reads its annotations."""
