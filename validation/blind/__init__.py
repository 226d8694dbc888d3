"""The blind protocol: cases from a simulator of its own, labels under seal, predictions, then scores."""
