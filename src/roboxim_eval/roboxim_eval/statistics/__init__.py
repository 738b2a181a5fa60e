"""Statistics of evaluations and experiments.

Two questions are never mixed:

- Q1, about checkpoints: is this checkpoint better than that one? The scenes are the sample (`paired`, `sequential`).
- Q2, about training conditions: does a condition change the success? The trainings are the sample (`replicates`).

Modules by subject: `rates` (one policy), `paired` (two policies), `replicates` (two training conditions), `scores`
(held-out cells), `verdicts` (sentences), `multiple` (several comparisons), `sequential` (stopping early), `power`
(planning).
"""
