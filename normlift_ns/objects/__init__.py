"""Objects in a selection: its parts, their oriented boxes, and a catalogue of them for other programs."""

from normlift_ns.objects.parts import Objects, SceneObject, connected_components, find_objects

__all__ = ["Objects", "SceneObject", "connected_components", "find_objects"]
