"""What the renderer study is made of: scenes, peers, floors, training steps, memory, tables and pictures."""
