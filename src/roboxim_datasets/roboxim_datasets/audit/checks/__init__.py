"""The checks, one file per family; importing this package registers them."""

from roboxim_core.registry import import_modules

import_modules(__name__, __path__)
