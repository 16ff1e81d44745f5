import jade.core.AID;
import jade.core.Agent;
import jade.core.behaviours.CyclicBehaviour;
import jade.core.behaviours.OneShotBehaviour;
import jade.lang.acl.ACLMessage;
import jade.lang.acl.MessageTemplate;
import java.util.Arrays;

/**
 * Sends requests to an agent of another platform and waits for each reply.
 *
 * With the arguments name, address, number and bytes it asks once and prints a summary. Without arguments it
 * waits for requests with this content, separated by blanks, and answers each with an inform: the numbers
 * of lost and of surplus replies, and the round trips in microseconds.
 */
public class AskAgent extends Agent {
    private static final int PATIENCE_MS = 10000;

    private int run = 0;
    private int lost;
    private int surplus;

    @Override
    protected void setup() {
        final Object[] arguments = getArguments();
        if (arguments != null && arguments.length >= 4) {
            addBehaviour(new OneShotBehaviour(this) {
                @Override
                public void action() {
                    // Until all agents of the platform have started.
                    myAgent.doWait(6000);
                    print(ask(Arrays.copyOf(arguments, 4, String[].class)));
                }
            });
            return;
        }
        addBehaviour(new CyclicBehaviour(this) {
            @Override
            public void action() {
                ACLMessage request = myAgent.receive(MessageTemplate.MatchPerformative(ACLMessage.REQUEST));
                if (request == null) {
                    block();
                    return;
                }
                double[] micros = ask(request.getContent().trim().split(" "));
                StringBuilder content = new StringBuilder().append(lost).append(' ').append(surplus);
                for (double one : micros) {
                    content.append(' ').append(Math.round(one));
                }
                ACLMessage reply = request.createReply();
                reply.setPerformative(ACLMessage.INFORM);
                reply.setContent(content.toString());
                send(reply);
            }
        });
    }

    /** Returns the round trips of the replies that arrived, in microseconds. */
    private double[] ask(String[] what) {
        AID to = new AID(what[0], AID.ISGUID);
        to.addAddresses(what[1]);
        int number = Integer.parseInt(what[2]);
        char[] content = new char[Integer.parseInt(what[3])];
        Arrays.fill(content, 'x');
        double[] micros = new double[number];
        int arrived = 0;
        run++;
        lost = 0;
        surplus = 0;
        for (int i = 0; i < number; i++) {
            String reference = "r" + run + "-" + i;
            ACLMessage request = new ACLMessage(ACLMessage.REQUEST);
            request.addReceiver(to);
            request.setContent(new String(content));
            request.setConversationId("c" + run + "-" + i);
            request.setReplyWith(reference);
            long began = System.nanoTime();
            send(request);
            ACLMessage reply = blockingReceive(MessageTemplate.MatchInReplyTo(reference), PATIENCE_MS);
            if (reply == null || reply.getPerformative() == ACLMessage.FAILURE) {
                lost++;
                System.out.println("asked " + i + ": " + reply);
            } else {
                micros[arrived++] = (System.nanoTime() - began) / 1000.0;
            }
        }
        ACLMessage other;
        while ((other = receive(MessageTemplate.not(MessageTemplate.MatchPerformative(ACLMessage.REQUEST)))) != null) {
            surplus++;
            System.out.println("surplus: " + other.getInReplyTo());
        }
        return Arrays.copyOf(micros, arrived);
    }

    private void print(double[] micros) {
        Arrays.sort(micros);
        double median = micros.length == 0 ? 0 : micros[micros.length / 2];
        double mean = Arrays.stream(micros).average().orElse(0);
        double variance = Arrays.stream(micros).map(it -> (it - mean) * (it - mean)).average().orElse(0);
        System.out.printf("ASKED %d lost %d surplus %d median_us %.1f mean_us %.1f deviation_us %.1f%n",
                micros.length + lost, lost, surplus, median, mean, Math.sqrt(variance));
    }
}
