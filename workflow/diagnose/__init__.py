"""Gap diagnosis with files: cases in; a JSON answer, a page and a repaired rig per case out."""
