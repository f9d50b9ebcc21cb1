"""What a scene contains and the export leaves out or changes."""

import math


class Problems:
    """Sentences about parts that are not exported, each once, in the order of their discovery (`sentences`)."""

    def __init__(self):
        self.sentences = []

    def add(self, owner, sentence):
        """Add a sentence about a data-block of Blender, which is named by its type and name."""
        self._keep(f"{owner.bl_rna.identifier} '{owner.name}': {sentence}")

    def add_setting(self, name, sentence):
        """Add a sentence about a setting of the scene by its name in Blender's panels."""
        self._keep(f"{name}: {sentence}")

    def _keep(self, text):
        if text not in self.sentences:
            self.sentences.append(text)


def differs(socket, default):
    """Whether a socket of a node is linked or has another value than the number `default`."""
    return socket.is_linked or not math.isclose(socket.default_value, default, abs_tol=1e-6)
