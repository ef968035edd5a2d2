# MuJoCo's compiled module comes without types; pyright would report every name of it as unknown.
from typing import Any

def __getattr__(name: str) -> Any: ...
