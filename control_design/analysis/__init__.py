"""What a given controller does: worst case, stability, margins, between grid points, certificate, time
responses.
"""
