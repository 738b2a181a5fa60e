"""An episode: what a bag holds, its judgement, and the page that scrubs it."""
