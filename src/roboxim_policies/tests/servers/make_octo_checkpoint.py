"""Makes a checkpoint of the genuine Octo model with random weights: `make_octo_checkpoint.py FOLDER OCTO DLIMP`.

It runs in Octo's environment, with clones of octo-models/octo and kvablack/dlimp. The model is octo-small-1.5's
(two cameras, two frames, a diffusion head of four actions of seven numbers, language through T5) with a transformer of
one layer and a T5 of one layer, so that it is compiled in a minute. The tokenizer knows single words. Everything that
the checkpoint names lies in its folder, so it loads without a network.
"""

import sys
from pathlib import Path

import numpy as np

WORDS = ["open", "close", "the", "drawer", "it", "pick", "up", "red", "cube", "push", "a", "to", "left", "right"]
LENGTH = 16
"""Tokens of an instruction, as in octo-small-1.5."""


def main(folder: Path, *sources: str) -> None:
    """Write the checkpoint."""
    sys.path[:0] = sources
    import jax
    from octo.data.utils.text_processing import HFTokenizer
    from octo.model.components.action_heads import DiffusionActionHead
    from octo.model.components.tokenizers import ImageTokenizer, LanguageTokenizer
    from octo.model.components.transformer import common_transformer_sizes
    from octo.model.components.vit_encoders import SmallStem16
    from octo.model.octo_model import OctoModel
    from octo.utils.spec import ModuleSpec

    language = folder.resolve() / "t5"  # Octo tells a T5 by the name of its folder
    write_language(language)
    size, transformer = common_transformer_sizes("dummy")
    cameras = {"primary": 256, "wrist": 128}
    tokenizer_options = {"max_length": LENGTH, "padding": "max_length", "truncation": True, "return_tensors": "np"}
    text_processor = ModuleSpec.create(
        HFTokenizer, tokenizer_name=str(language), encode_with_model=False, tokenizer_kwargs=tokenizer_options
    )
    model = {
        "observation_tokenizers": {
            name: ModuleSpec.create(
                ImageTokenizer, obs_stack_keys=[f"image_{name}"], task_stack_keys=[f"image_{name}"],
                encoder=ModuleSpec.create(SmallStem16),
            )
            for name in cameras
        },
        "task_tokenizers": {"language": ModuleSpec.create(LanguageTokenizer, encoder=str(language))},
        "heads": {
            "action": ModuleSpec.create(
                DiffusionActionHead, readout_key="readout_action", use_map=False, action_horizon=4, action_dim=7,
                n_diffusion_samples=1, dropout_rate=0.0,
            )
        },
        "readouts": {"action": 1}, "token_embedding_size": size, "transformer_kwargs": transformer,
        "max_horizon": 10, "use_correct_attention": True, "repeat_task_tokens": True,
    }  # fmt: skip
    processor = ModuleSpec.instantiate(text_processor)()
    made = OctoModel.from_config(
        {"model": model, "text_processor": text_processor, "window_size": 2},
        example_batch(cameras, dict(processor.encode(["open the drawer"]))),
        processor,
        rng=jax.random.PRNGKey(0),
        dataset_statistics=jax.tree_util.tree_map(np.array, STATISTICS, is_leaf=lambda part: isinstance(part, list)),
    )
    made.save_pretrained(0, str(folder.resolve()))


STATISTICS = {
    name: {"action": {"mean": [0.0] * 7, "std": [std] * 7, "mask": [True] * 6 + [False]}}
    for name, std in (("bridge_dataset", 0.01), ("fractal20220817_data", 0.02))
}


def example_batch(cameras: dict, text: dict) -> dict:
    """Return a batch of one with the shapes that the model takes."""
    pictures = {f"image_{name}": np.zeros((1, 2, size, size, 3), np.uint8) for name, size in cameras.items()}
    goals = {key: value[:, 0] for key, value in pictures.items()}
    return {
        "observation": {
            **pictures,
            "timestep": np.zeros((1, 2), np.int32),
            "timestep_pad_mask": np.ones((1, 2), bool),
            "pad_mask_dict": {key: np.ones((1, 2), bool) for key in (*pictures, "timestep")},
        },
        "task": {
            **goals,
            "timestep": np.zeros((1,), np.int32),
            "language_instruction": text,
            "pad_mask_dict": {key: np.ones((1,), bool) for key in (*goals, "timestep", "language_instruction")},
        },
        "action": np.zeros((1, 2, 4, 7), np.float32),
    }


def write_language(folder: Path) -> None:
    """Write the configuration of a small T5, and a tokenizer of single words."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast, T5Config

    folder.mkdir(parents=True)
    known = {word: number for number, word in enumerate(["<pad>", "<unk>", "</s>", *WORDS])}
    T5Config(vocab_size=len(known), d_model=32, d_kv=16, d_ff=64, num_layers=1, num_heads=2).save_pretrained(folder)
    tokenizer = Tokenizer(models.WordLevel(known, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>", eos_token="</s>",
        model_input_names=["input_ids", "attention_mask"],
    ).save_pretrained(folder)  # fmt: skip


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
