((p a "b \"c\"" #3"d)\" -1 0x1F 2.5e-3 true 20000508T042651481Z ?x ??m)
 (p (f) (f a b) (pose :x 1.5 :y 0.2) (sequence 1 (set)) (action a (f)) (iota ?x (p ?x)))
 (p (search (sequence stop (pose 1 2)) (set (property :name a :value 1)))))
