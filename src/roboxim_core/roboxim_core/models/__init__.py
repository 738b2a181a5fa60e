"""One description of each robot and object, for physics, collision checks and tasks."""
