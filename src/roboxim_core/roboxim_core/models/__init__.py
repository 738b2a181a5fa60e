"""One description of each robot and object: sim realises it, planner collides with it, tasks reads its notes."""
